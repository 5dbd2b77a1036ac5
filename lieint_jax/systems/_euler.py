"""Generalized Euler equations: geodesics of a left- or right-invariant metric on any group (Section 5.1.6)."""

from __future__ import annotations

from typing import Literal, get_args, overload

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import at_once, concrete
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import DualVector, MomentumMap, Scalar, Vector6
from lieint_jax.core import Group, State, pytree, static
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractGeodesicFlow, AbstractRightGeodesicFlow
from lieint_jax.systems._shared.on_group import OnGroup

__all__ = ["Euler", "RightEuler", "euler", "kirchhoff", "kirchhoff_spin", "manakov", "manakov_integrals"]


@pytree
class Euler(OnGroup, AbstractGeodesicFlow):
    """H = ½⟨Π, m⁻¹Π⟩ with Π = Ad*_q π (5.18); q̇ = qΩ̂, π̇ = 0, Ω = m⁻¹Π (5.14). Made by `euler`."""

    metric: Array
    group: Group = static()


@pytree
class RightEuler(OnGroup, AbstractRightGeodesicFlow):
    """H = ½⟨π, m⁻¹π⟩ (end of Section 5.1.7); q̇ = ω̂q, π̇ = −ad*_ω π, ω = m⁻¹π. Made by `euler`."""

    metric: Array
    group: Group = static()
    velocity_kind = "spatial_velocity"

    def energy(self, state: State) -> Scalar:
        """½⟨π, m⁻¹π⟩."""
        return vectors.dot(state.p, self.velocity(state)) / 2

    def momentum(self, state: State) -> DualVector:
        """The momentum map of the right action (5.21): Π = Ad*_q π, shape (d,)."""
        return self.body_momentum(state)


Invariance = Literal["left", "right"]


@overload
def euler(group: Group, metric: ArrayLike, invariance: Literal["left"] = "left") -> Euler: ...
@overload
def euler(group: Group, metric: ArrayLike, invariance: Literal["right"]) -> RightEuler: ...
def euler(group: Group, metric: ArrayLike, invariance: Invariance = "left") -> Euler | RightEuler:
    """Geodesic motion on a group: the free rigid body for SO(3), a body in a perfect fluid for SE(3), …

    | invariance | energy | conserved momentum | an example |
    |---|---|---|---|
    | "left" | ½⟨Π, m⁻¹Π⟩ of the body momentum Π = Ad*_q π | π (5.14) | rigid bodies |
    | "right" | ½⟨π, m⁻¹π⟩ of the spatial momentum π | Π | perfect fluids in a fixed vessel, q a diffeomorphism |

    Args:
        group: `groups.so3`, a group of the catalogue, or `groups.matrix(basis)`.
        metric: m in the basis of the group, positive definite: its diagonal, shape (d,), or in full, (d, d).
        invariance: under which translations of the group the energy is invariant, "left" or "right".

    Raises:
        ValueError: a wrong shape, NaN or inf, not symmetric or not positive definite; another invariance.

    Source: Lewis & Simo 1994, Section 5.1; Arnold, Ann. Inst. Fourier 16 (1966) 319.

    Example:
        >>> from lieint_jax import groups
        >>> plane = euler(groups.special_euclidean(2), [2.0, 1.0, 1.0])
        >>> float(plane.energy(plane.state(velocity=[1.0, 2.0, 0.0])))
        3.0
    """
    if invariance not in get_args(Invariance):
        raise ValueError(f"invariance must be 'left' or 'right', got {invariance!r}")
    metric = _checks.positive_definite("metric", metric, group.dim, mixed_units=True)
    return Euler(metric, group) if invariance == "left" else RightEuler(metric, group)


def kirchhoff(semi_axes: tuple[float, float, float] = (3.0, 2.0, 1.0), center_of_mass: ArrayLike = (0, 0, 0)) -> Euler:
    """A neutrally buoyant ellipsoid in a perfect fluid at rest at infinity: Kirchhoff's equations on SE(3).

    The metric is that of body and fluid, with the masses of the body and of the displaced fluid equal to 1. With
    semi-axes a, b, c and A_i = abc ∫₀^∞ ds / ((i² + s)√((a²+s)(b²+s)(c²+s))), A_a + A_b + A_c = 2, the added mass
    along a is A_a/(2 − A_a), the added inertia about a is

        (1/5) (b² − c²)² (A_c − A_b) / (2(b² − c²) + (b² + c²)(A_b − A_c)),

    and cyclically. The body is homogeneous except for a shift of its center of mass, which couples rotation and
    translation by the block m r̂ of the metric. Basis: rotations, then translations, along the axes of the ellipsoid.

    Args:
        semi_axes: a, b, c, positive, in any unit of length. They may be equal.
        center_of_mass: r, from the center of the ellipsoid, in its axes. The moments of inertia about r are those of
            the homogeneous body about its center.

    Source: Lamb, Hydrodynamics, 6th ed., §§114–115, 124, 126; Kirchhoff 1869; Leonard, Automatica 33 (1997) 331
    (stability of underwater vehicles).
    """
    from lieint_jax.groups import special_euclidean

    if not _checks.concrete(semi_axes, center_of_mass):
        raise ValueError(
            "semi_axes and center_of_mass must be known numbers: call kirchhoff outside jit, vmap and grad"
        )
    axes = _checks.host_array("semi_axes", semi_axes, float)
    if axes.shape != (3,) or not np.all(np.isfinite(axes)) or axes.min() <= 0:
        raise ValueError(f"semi_axes must be three positive lengths, got {semi_axes}")
    with at_once():
        r = np.asarray(_checks.real_array("center_of_mass", center_of_mass, (3,)), float)
    A = _depolarization(axes)
    added_mass = A / (np.roll(A, 1) + np.roll(A, 2))  # the other two, 2 − A: no digits cancel for a disc
    added_inertia, inertia = np.zeros(3), np.zeros(3)
    for i in range(3):
        (b, B), (c, C) = ((axes[k] ** 2, A[k]) for k in ((i + 1) % 3, (i + 2) % 3))
        inertia[i] = (b + c) / 5
        if abs(b - c) > 1e-9 * (b + c):
            rest = (b + c) * (A[i] + 2 * min(B, C)) - 4 * min(b, c)  # |2(b − c) + (b + c)(B − C)|
            added_inertia[i] = (b - c) ** 2 * abs(C - B) / rest / 5
    skew = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
    J = np.diag(inertia + added_inertia) - skew @ skew
    return euler(special_euclidean(3), np.block([[J, skew], [-skew, np.diag(1 + added_mass)]]))


def kirchhoff_spin(body: Euler) -> float:
    """The least |Π₃/P₃| with which a body of revolution in a fluid moves stably along its axis, 0 if it needs no spin.

    It is 2√(I₁(1/m₃ − 1/m₁)) with the moments and masses of body and fluid. NaN unless it is a body of revolution about
    the third axis with a central mass, whose spin is known in closed form.

    Args:
        body: a `kirchhoff`.

    Source: Lamb, Hydrodynamics, 6th ed., § 128.

    Example:
        >>> round(kirchhoff_spin(kirchhoff((1.0, 1.0, 2.99))), 4)
        1.9785
    """
    m = np.asarray(body.metric)
    I1, _, I3, m1, _, m3 = np.diag(m)
    units = np.sqrt(np.repeat([m[:3, :3].max(), m[3:, 3:].max()], 3))
    off = np.abs(m - np.diag([I1, I1, I3, m1, m1, m3])) / (units[:, None] * units)
    if off.max() > 1e-12:
        return float("nan")
    return float(2 * np.sqrt(max(I1 * (1 / m3 - 1 / m1), 0.0)))


def manakov(a: ArrayLike = (1.0, 2.0, 3.5, 5.0)) -> Euler:
    """The free n-dimensional rigid body: J = diag(a), so that Π_ij = (a_i + a_j) Ω_ij. Integrable (Manakov 1976).

    Source: Manakov, Funct. Anal. Appl. 10 (1976) 328; Ratiu, Indiana Univ. Math. J. 29 (1980) 609.
    """
    from lieint_jax.groups import special_orthogonal

    array = _checks.real_array("a", a)
    if array.ndim != 1 or len(array) < 4 or (concrete(array) and np.asarray(array).min() <= 0):
        raise ValueError(f"a must be at least four positive numbers, got {a}; for n = 3 see rigid_body")
    i, j = np.triu_indices(len(array), 1)
    return Euler(array[i] + array[j], special_orthogonal(len(array)))


def manakov_integrals(a: ArrayLike, Pi: Vector6) -> MomentumMap:
    """Coefficients of tr(Π̂ + λJ²)ᵏ in λ, for k = 2 … n: every invariant of `manakov(a)`, shape (Σ k,).

    Args:
        a: as given to `manakov`, shape (n,).
        Pi: body momentum, shape (n(n−1)/2,).
    """
    _checks.all_plain(a=a, Pi=Pi)
    a = jnp.asarray(a)
    n = len(a)
    M = jnp.zeros((n, n), Pi.dtype).at[np.triu_indices(n, 1)].set(Pi)
    M, J2 = M - M.T, jnp.diag(a * a)
    found, power = [], [M, J2]  # power[l]: the coefficient of λˡ in (M + λJ²)ᵏ
    for _ in range(2, n + 1):
        lower = [P @ M for P in power] + [jnp.zeros_like(M)]
        upper = [jnp.zeros_like(M)] + [P @ J2 for P in power]
        power = [x + y for x, y in zip(lower, upper, strict=True)]
        found += [jnp.trace(P) for P in power[:-1]]
    return jnp.stack(found)


PROPERTIES = SystemProperties(
    name="euler",
    models="geodesics of a matrix group; `kirchhoff` and `manakov` are special ones",
    phase_space="T*G: matrix (n, n), π (d,)",
    conserves=("energy", "momentum", "Casimirs"),
    momentum="π, of a right-invariant metric Π",
    sizes=(),
    aliases=("Euler–Poincaré equations", "Euler–Arnold equations", "Kirchhoff's equations", "Manakov's top"),
    source="Lewis & Simo 1994, Section 5.1; Arnold 1966",
)


def examples() -> dict[str, tuple[Euler | RightEuler, State, float]]:
    """Kirchhoff's ellipsoid, its center of mass below its center; a four-dimensional body; a right-invariant flow."""
    from lieint_jax.groups import special_orthogonal

    right = euler(special_orthogonal(3), [1.0, 2.0, 3.0], "right")
    ellipsoid, body = kirchhoff(center_of_mass=(0.0, 0.0, -0.2)), manakov()
    return {
        "kirchhoff": (ellipsoid, ellipsoid.state(velocity=[0.3, -0.4, 0.5, 0.6, 0.2, -0.3]), 0.1),
        "manakov": (body, body.state(velocity=[0.5, -0.3, 0.4, 0.2, 0.6, -0.4]), 0.1),
        "right": (right, right.state(velocity=[0.3, -0.2, 0.4]), 0.1),
    }


def _depolarization(axes: np.ndarray) -> np.ndarray:
    """abc ∫₀^∞ ds / ((i² + s)√((a²+s)(b²+s)(c²+s))), each i, by the trapezoidal rule in ln s.

    There the integrand is analytic for |Im ln s| < π, and decays exponentially at both ends: the error is
    exp(−2π²/h) = 4e-22, for any ratio of the axes.
    """
    h, squares = 0.4, axes[:, None] ** 2
    s = np.exp(np.arange(np.log(squares.min()) - 40, np.log(squares.max()) + 40, h))
    ratio = np.prod(axes[:, None] / np.sqrt(squares + s), axis=0)  # abc/√…
    return h * np.sum(ratio * s / (squares + s), axis=1)
