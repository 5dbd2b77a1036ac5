"""The stored energy of a rod as a chain of rigid cross sections, a function of invariants quadratic in their poses.

The columns of Λ_i and Λ_{i+1} are the directors of two sections; ℓ is the length of the element between them in the
natural shape, and H the rotation of half of it. With the columns a_k of Λ_iH and b_k of Λ_{i+1}Hᵀ, equal in the natural
shape, and the mean d_k of the directors,

    Γ_k = d_k·(x_{i+1} − x_i)/ℓ,   s = ½(a₃·b₂ − a₂·b₃, a₁·b₃ − a₃·b₁, a₂·b₁ − a₁·b₂),   o_k = ½|a_k − b_k|²
    V = ½ℓ(Γ − Γ₀)·C_Γ(Γ − Γ₀) + V_b(s, o)

An element whose curvature differs from the natural one by κ in the axes of its middle has HᵀΛ_iᵀΛ_{i+1}Hᵀ = exp(ℓκ̂).
If it turns by θ = ℓκ about one axis, s = sin θ and two of o are 1 − cos θ. With C_κ = diag(EI₁, EI₂, GJ) and the
diagonal A = ½ tr(C_κ) − C_κ,

    directors   V_b = (1/2ℓ) s·C_κs                       = ½ℓ κ·C_κκ (1 − θ²/3 + …)
    fourth      V_b = (1/ℓ)[(4/3) A·o − (1/6) s·C_κs]     = ½ℓ κ·C_κκ (1 − θ⁴/90 + …)

Both are quadratic in Γ, s and o, so their discrete gradient is the gradient at the mean. About one axis V_b is convex
up to cos θ = 1 − ½√6, θ = 103°, and up to 45° for the directors. About any axis, as a function of the rotation vector,
it is convex up to 102° and 45° for stiffnesses within a factor of 2, by its Hessian, and less far for others. V is NaN
where an element turns further than about one axis: Σo = 2(1 − cos θ).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Calls, PoseMomenta, Poses, Positions, Rotations, Scalar
from lieint_jax._numerics.power_series import stumpff
from lieint_jax._xla import compiled
from lieint_jax.core import pytree, static
from lieint_jax.groups import so3
from lieint_jax.potentials._potential import Potential

__all__ = ["Rod", "rod"]

_OTHERS = ((1, 2), (2, 0), (0, 1))
_ENERGIES = {"fourth": (4 / 3, -1 / 3), "directors": (0.0, 1.0)}  # the factors of A·o/ℓ and of s·C_κs/2ℓ
_FARTHEST = {"fourth": 6**0.5, "directors": 2 - 2**0.5}  # Σo where V_b ceases to be convex


@pytree
class Rod(Potential):
    """The stored energy of N rigid cross sections, each bound to the next. Made by `rod`."""

    lengths: Array  # ℓ of the elements in the natural shape, (N − 1,)
    stretching: Array  # (GA₁, GA₂, EA) of the elements, (N − 1, 3)
    bending: Array  # (EI₁, EI₂, GJ) of the elements, (N − 1, 3)
    natural_strain: Array  # Γ₀, (N − 1, 3)
    half_turn: Array  # H, (N − 1, 3, 3)
    energy: str = static(default="fourth")
    chain = True
    domain = (
        "potentials.rod has no value where an element turns by more than 103° from its natural shape (45° with the "
        "energy of directors), beyond which its energy is not convex: use more elements"
    )

    @property
    def count(self) -> int:
        return self.lengths.shape[0] + 1

    def invariants(self, x: Positions, R: Rotations) -> tuple[Array, Array, Array]:
        """Γ, s and o of the elements, each (N − 1, 3)."""
        d, apart = (R[:-1] + R[1:]) / 2, (x[1:] - x[:-1]) / self.lengths[:, None]
        a, b = self._middle(R)
        s = [jnp.sum(a[:, :, k] * b[:, :, j] - a[:, :, j] * b[:, :, k], axis=1) / 2 for j, k in _OTHERS]
        return jnp.sum(d * apart[:, :, None], axis=1), jnp.stack(s, axis=1), jnp.sum((a - b) ** 2, axis=1) / 2

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ, (N, 6), with half the operations of autodiff of V.

        An element pulls its sections with ∓f and turns them by ±t, f = ½(Λ_i + Λ_{i+1})n with n = C_Γ(Γ − Γ₀). In the
        axes a_k, with B_jk = a_j·b_k, a rotation δ of the second section changes s by ½(tr(B)δ − Bδ) and A·o by
        −Σ A_k b_k × e_k · δ, so t is the gradient of V_b by δ.
        """
        apart, d = x[1:] - x[:-1], (R[:-1] + R[1:]) / 2
        strain = jnp.sum(d * apart[:, :, None], axis=1) / self.lengths[:, None]
        n = self.stretching * (strain - self.natural_strain)
        before, after = (jnp.sum(turned * n[:, None, :], axis=2) for turned in (R[:-1], R[1:]))
        f, t = (before + after) / 2, self._moment(R)
        first = jnp.concatenate([f, t - jnp.cross(before, apart) / 2], axis=1)
        second = jnp.concatenate([-f, -t - jnp.cross(after, apart) / 2], axis=1)
        none = jnp.zeros_like(first[:1])
        return jnp.concatenate([first, none]) + jnp.concatenate([none, second])

    def _moment(self, R: Rotations) -> Array:
        """The moment of bending and torsion on the first section of each element, in space, (N − 1, 3)."""
        opened, squared = _ENERGIES[self.energy]
        a, b = self._middle(R)
        B = _product(jnp.swapaxes(a, 1, 2), b)
        s = jnp.stack([B[:, k, j] - B[:, j, k] for j, k in _OTHERS], axis=1) / 2
        o = 1 - jnp.diagonal(B, axis1=1, axis2=2)
        A, C_s = self._opposite + self._outside(o), squared / 2 * self.bending * s
        open_ = jnp.stack([A[:, j] * B[:, k, j] - A[:, k] * B[:, j, k] for j, k in _OTHERS], axis=1)
        t = opened * open_ + jnp.trace(B, axis1=1, axis2=2)[:, None] * C_s - jnp.sum(B * C_s[:, :, None], axis=1)
        return jnp.sum(a * (t / self.lengths[:, None])[:, None, :], axis=2)

    def value(self, invariants: tuple[Array, Array, Array]) -> Scalar:
        """V of Γ, s and o."""
        strain, s, o = invariants
        opened, squared = _ENERGIES[self.energy]
        stretched = jnp.sum(self.stretching * (strain - self.natural_strain) ** 2, axis=1)
        bent = jnp.sum(2 * opened * self._opposite * o + squared * self.bending * s**2 + self._outside(o), axis=1)
        return jnp.sum(self.lengths * stretched + bent / self.lengths) / 2

    def discrete_gradient(
        self, start: tuple[Array, Array, Array], end: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """D with D·(end − start) = V(end) − V(start): the gradient at the mean, as V is quadratic."""
        strain, s, _ = ((a + b) / 2 for a, b in zip(start, end, strict=True))
        opposite = self._opposite + self._outside(start[2]) + self._outside(end[2])
        opened, squared = _ENERGIES[self.energy]
        lengths = self.lengths[:, None]
        along_strain = lengths * self.stretching * (strain - self.natural_strain)
        return along_strain, squared * self.bending * s / lengths, opened * opposite / lengths

    def _middle(self, R: Rotations) -> tuple[Array, Array]:
        """The axes a_k and b_k of the two sections of each element, (N − 1, 3, 3)."""
        return _product(R[:-1], self.half_turn), _product(R[1:], jnp.swapaxes(self.half_turn, 1, 2))

    def _outside(self, o: Array) -> Array:
        """NaN for elements whose energy is not convex, otherwise 0, (N − 1, 1)."""
        return jnp.where(jnp.sum(o, axis=1, keepdims=True) < _FARTHEST[self.energy], 0.0, jnp.nan).astype(o.dtype)

    def natural_shape(self, first: Array) -> Poses:
        """The poses (N, 7) of the sections in the natural shape, where V = 0, from that of the first, (7,)."""
        whole = _product(self.half_turn, self.half_turn)
        mean = (jnp.eye(3, dtype=whole.dtype) + whole) / 2  # of the directors, in the first section
        chord = jax.vmap(lambda d, strain: jnp.stack(vectors.matrix(d.T).solve(strain)))(mean, self.natural_strain)

        def following(pose: Array, element: tuple[Array, Array]) -> tuple[Array, Array]:
            x, q = pose[:3], pose[3:]
            turned = so3.normalize(so3.multiply(q, element[1]))
            pose = jnp.concatenate([x + so3.Ad(q, element[0]), turned])
            return pose, pose

        steps = self.lengths[:, None] * chord, jax.vmap(so3.from_matrix)(whole)
        return jnp.concatenate([first[None], lax.scan(following, first, steps)[1]])

    @property
    def _opposite(self) -> Array:
        """A, (N − 1, 3)."""
        return jnp.sum(self.bending, axis=1, keepdims=True) / 2 - self.bending


def rod(
    lengths: ArrayLike,
    stretching: ArrayLike,
    bending: ArrayLike,
    natural_curvature: ArrayLike = 0.0,
    *,
    energy: str = "fourth",
) -> Rod:
    """The stored energy of a rod of N rigid cross sections, each bound to the next by an element.

    The third axis of a section is its normal, along the rod where there is no shear. V is invariant: P and L are
    conserved.

    Args:
        lengths: ℓ of the elements in the natural shape, (N − 1,).
        stretching: the stiffness (GA₁, GA₂, EA) against shear and extension, (3,) or (N − 1, 3); ≥ 0.
        bending: the stiffness (EI₁, EI₂, GJ) against bending and torsion, (3,) or (N − 1, 3); ≥ 0.
        natural_curvature: κ₀ in the axes of the sections, two curvatures and the twist, per unit of length, (3,) or
            (N − 1, 3); 0 for a straight rod.
        energy: "fourth", quadratic in the curvature up to O(ℓκ)⁴, or "directors", up to O(ℓκ)².

    Raises:
        ValueError: shapes disagree, a length is not positive, a stiffness is negative, or `energy` is unknown.

    Source: Romero & Armero 2002, Int. J. Numer. Methods Eng. 54; Betsch & Steinmann 2002, Int. J. Numer. Methods Eng.
    54; the energy of fourth order: this package.
    """
    ell = _checks.real_array("lengths", lengths)
    if ell.ndim != 1 or not ell.size:
        raise ValueError(f"lengths must have shape (N - 1,), one for each element, got {ell.shape}")
    ell = _checks.positive("lengths", ell, ell.shape)
    rows = (ell.size, 3)
    along, turning = (
        jnp.broadcast_to(_checks.not_negative(name, given, (3,), rows), rows)
        for name, given in (("stretching", stretching), ("bending", bending))
    )
    if energy not in _ENERGIES:
        raise ValueError(f"energy must be one of {', '.join(_ENERGIES)}, got {energy!r}")
    curvature = jnp.broadcast_to(_checks.real_array("natural_curvature", natural_curvature, (), (3,), rows), rows)
    strain, half = _natural(ell, curvature)
    return Rod(ell, along, turning, strain, half, energy)


@partial(compiled, once=True)
def _natural(lengths: Array, curvature: Array) -> tuple[Array, Array]:
    """Γ₀ and H of elements with a curvature along their whole lengths.

    In the axes of the middle, with θ = ℓκ₀, Γ₀ = sinc |θ| e₃ + (1 − sinc |θ|) θ₃θ/|θ|²: the product of the mean of the
    directors, which is cos ½|θ| across θ, with the chord, sinc ½|θ| across θ; both are 1 along θ.
    """
    turn = lengths[:, None] * curvature
    _, sinc, _, g = stumpff(jnp.sum(turn**2, axis=1, keepdims=True))
    strain = g * turn[:, 2:] * turn + sinc * jnp.array([[0, 0, 1.0]], turn.dtype)
    return strain, jax.vmap(so3.to_matrix)(jax.vmap(so3.exp)(turn / 2))


def _product(A: Array, B: Array) -> Array:
    """A B of matrices (k, 3, 3)."""
    return jnp.sum(A[:, :, :, None] * B[:, None, :, :], axis=2)


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    pair, chain = (jnp.array([[1.3, 1.1, 2.0]]), jnp.array([[0.3, 0.4, 0.2]])), jnp.array([0.7])
    curved = {"natural_curvature": jnp.array([[0.3, -0.5, 0.7]]), "energy": "fourth"}
    return {"rod": partial(rod, lengths=chain, stretching=pair[0], bending=pair[1], **curved)}
