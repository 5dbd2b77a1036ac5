"""Gravity of bodies of any shape to order 4 of their size over their distance, by their trace-free moments.

With d = x_j − x_i, r = |d|, Γ_i = Λ_iᵀd, Γ_j = Λ_jᵀd, C = Λ_iᵀΛ_j, and the trace-free parts Q, T, F of a body's second,
third and fourth moments,

    −V/G = m_i m_j/r + (3/2r⁵) (m_j Q_i(Γ_i²) + m_i Q_j(Γ_j²)) + (5/2r⁷) (m_j T_i(Γ_i³) − m_i T_j(Γ_j³))
         + (35/8r⁹) (m_j F_i(Γ_i⁴) + m_i F_j(Γ_j⁴))
         + (105/4r⁹) Q_i(Γ_i²) Q_j(Γ_j²) − (15/r⁷) Γ_i·Q_i C Q_j Γ_j + (3/2r⁵) tr(Q_i C Q_j Cᵀ)

for each pair, which are all terms of the expansion up to the order: traces drop out, as 1/r is harmonic. V is a sum of
factors F_p(Γ_i, Γ_j, C) over r^p with p = 1, 5, 7, 9, and so are its derivatives and its discrete gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls
from lieint_jax.core import pytree, static
from lieint_jax.potentials._potential import Potential
from lieint_jax.shapes import Shape, box, ellipsoid, trace_free

__all__ = ["mutual_gravity"]

_POWERS = (1, 5, 7, 9)


@pytree
class MutualGravity(Potential):
    """Gravity of bodies by their trace-free moments about their centers, in their axes. Made by `mutual_gravity`."""

    G: Array
    masses: Array
    second: Array  # (N, 3, 3)
    third: Array  # (N, 3, 3, 3)
    fourth: Array  # (N, 3, 3, 3, 3)
    radii: Array  # of the spheres that enclose the bodies; 0 for points and where the radius is unknown
    order: int = static()
    domain = (
        "mutual_gravity has no value where the center of a body is inside the enclosing sphere of another, where its "
        "series may diverge. Use potentials.polyhedron, which is exact there, if all bodies but one are small"
    )

    @property
    def count(self) -> int:
        return self.masses.shape[0]

    def invariants(self, x: Array, R: Array) -> Array:
        """r², Γ_i and Γ_j of each of k pairs, (7k,); to order 4 also C, (16k,)."""
        i, j = self._pairs
        d = x[j] - x[i]
        Gamma = [jnp.sum(R[n] * d[:, :, None], axis=1).ravel() for n in (i, j)]
        C = [jnp.sum(R[i][:, :, :, None] * R[j][:, :, None, :], axis=1).ravel()] * (self.order == 4)
        return jnp.concatenate([jnp.sum(d * d, axis=1), *Gamma, *C])

    def value(self, invariants: Array) -> Array:
        """V of the invariants."""
        at = self._split(invariants)
        a = 1 / jnp.sqrt(at.u)
        return -self.G * jnp.sum(sum(F * a**p for F, p in zip(self._factors(at), _POWERS, strict=False)))

    def discrete_gradient(self, start: Array, end: Array) -> Array:
        """D with D·(end − start) = V(end) − V(start), in closed form, without cancellation."""
        slopes = self._slopes(self._split(start), self._split(end))
        return jnp.concatenate([x.ravel() for x in slopes if x is not None])

    def force(self, x: Array, R: Array) -> Array:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ, (N, 6)."""
        (i, j), at = self._pairs, self._split(self.invariants(x, R))
        slopes, d = self._slopes(at, at), x[j] - x[i]
        arms = [_times(R[n], slope) for n, slope in ((i, slopes.Gamma_i), (j, slopes.Gamma_j))]
        pull = 2 * slopes.u[:, None] * d + arms[0] + arms[1]
        torques = [jnp.cross(d, arm) for arm in arms]
        if slopes.C is not None:
            W = jnp.sum(R[i][:, :, None, :, None] * R[j][:, None, :, None, :] * slopes.C[:, None, None], axis=(3, 4))
            turn = jnp.stack([W[:, 1, 2] - W[:, 2, 1], W[:, 2, 0] - W[:, 0, 2], W[:, 0, 1] - W[:, 1, 0]], axis=1)
            torques = [torques[0] - turn, torques[1] + turn]
        rows = jnp.concatenate([jnp.concatenate([pull, -pull]), jnp.concatenate(torques)], axis=1)
        of_each = np.argsort(np.concatenate([i, j]), kind="stable").reshape(self.count, -1)
        return jnp.sum(rows[of_each], axis=1)

    def _factors(self, at: _Invariants) -> list[Array]:
        """F_p of each pair, for the powers p up to the order."""
        (i, j), m = self._pairs, self.masses
        Q, T, F = self.second, self.third, self.fourth
        q = [_dot(_times(Q[n], G), G) for n, G in ((i, at.Gamma_i), (j, at.Gamma_j))]
        factors = [m[i] * m[j], 1.5 * (m[j] * q[0] + m[i] * q[1])]
        if self.order >= 3:
            t = [_dot(_times(_times(T[n], G), G), G) for n, G in ((i, at.Gamma_i), (j, at.Gamma_j))]
            factors.append(2.5 * (m[j] * t[0] - m[i] * t[1]))
        if self.order == 4:
            f = [_dot(_times(_times(_times(F[n], G), G), G), G) for n, G in ((i, at.Gamma_i), (j, at.Gamma_j))]
            arm_i, arm_j = _times(Q[i], at.Gamma_i), _times(Q[j], at.Gamma_j)
            factors[1] += 1.5 * jnp.sum(_product(_product(Q[i], at.C), Q[j]) * at.C, axis=(1, 2))
            factors[2] -= 15 * _dot(arm_i, _times(at.C, arm_j))
            factors.append(4.375 * (m[j] * f[0] + m[i] * f[1]) + 26.25 * q[0] * q[1])
        return factors

    def _slopes(self, start: _Invariants, end: _Invariants) -> _Invariants:
        """The discrete gradient of each pair; the gradient where both are equal."""
        (i, j), m = self._pairs, self.masses
        a, b = 1 / jnp.sqrt(start.u), 1 / jnp.sqrt(end.u)
        by_u = -a * a * b * b / (a + b)  # of a: (b − a)/(u₁ − u₀)
        factors = zip(self._factors(start), self._factors(end), _POWERS, strict=False)
        along_u = sum((F0 + F1) / 2 * by_u * sum(a**k * b ** (p - 1 - k) for k in range(p)) for F0, F1, p in factors)
        mean = {p: -self.G * (a**p + b**p) / 2 for p in _POWERS}
        ends = [(i, j, 1, start.Gamma_i, end.Gamma_i), (j, i, -1, start.Gamma_j, end.Gamma_j)]
        along = [self._along_Gamma(n, m[other], sign, G0, G1, mean) for n, other, sign, G0, G1 in ends]
        along_C = None
        if self.order == 4:
            Q, C = self.second, (start.C + end.C) / 2
            arms = [(_times(Q[n], G0), _times(Q[n], G1)) for n, _, _, G0, G1 in ends]
            squares = [
                (_dot(arm0, G0) + _dot(arm1, G1)) / 2 for (arm0, arm1), (*_, G0, G1) in zip(arms, ends, strict=True)
            ]
            p, q = ((arm0 + arm1) / 2 for arm0, arm1 in arms)
            seen = (_times(start.C, arms[1][0]) + _times(end.C, arms[1][1])) / 2
            across = [_times(Q[i], seen), _times(Q[j], _times(jnp.swapaxes(C, 1, 2), p))]
            along = [
                D + 52.5 * _scale_each(mean[9] * square, arm) - 15 * _scale_each(mean[7], other)
                for D, square, arm, other in zip(along, squares[::-1], (p, q), across, strict=True)
            ]
            along_C = 3 * _scale_each(mean[5], _product(_product(Q[i], C), Q[j])) - 15 * _scale_each(
                mean[7], p[:, :, None] * q[:, None]
            )
        return _Invariants(-self.G * along_u, along[0], along[1], along_C)

    def _along_Gamma(
        self, n: np.ndarray, other: Array, sign: int, G0: Array, G1: Array, mean: dict[int, Array]
    ) -> Array:
        """The discrete gradient of the terms with one body's shape only, with respect to its Γ."""
        total = G0 + G1
        D = 1.5 * _scale_each(other * mean[5], _times(self.second[n], total))
        if self.order >= 3:
            T = self.third[n]
            D += 2.5 * sign * _scale_each(other * mean[7], _times(_times(T, total), total) - _times(_times(T, G0), G1))
        if self.order == 4:
            F = _times(self.fourth[n], total)
            D += 4.375 * _scale_each(other * mean[9], _times(_times(F, G0), G0) + _times(_times(F, G1), G1))
        return D

    @property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        return np.triu_indices(self.count, 1)  # pyright: ignore[reportReturnType]

    def _split(self, invariants: Array) -> _Invariants:
        k = self.count * (self.count - 1) // 2
        u, Gamma_i, Gamma_j, C = jnp.split(invariants, [k, 4 * k, 7 * k])
        i, j = self._pairs
        u = jnp.where(u > jnp.maximum(self.radii[i], self.radii[j]) ** 2, u, jnp.nan)
        return _Invariants(
            u, Gamma_i.reshape(k, 3), Gamma_j.reshape(k, 3), C.reshape(k, 3, 3) if self.order == 4 else None
        )


class _Invariants(NamedTuple):
    """The invariants of k pairs, or numbers that belong to them."""

    u: Array  # r², (k,)
    Gamma_i: Array  # (k, 3)
    Gamma_j: Array  # (k, 3)
    C: Any  # (k, 3, 3), or None below order 4


def mutual_gravity(G: ArrayLike, shapes: Sequence[Shape | ArrayLike], order: int = 4) -> MutualGravity:
    """Gravity of N bodies of any shape, to a given order of their size over their distance, for every pair.

    All terms up to the order are included, also those that couple both shapes. To order 2 it equals `maccullagh`.
    Homogeneous spheres attract as points, exactly. The series converges where the enclosing spheres of the bodies do
    not intersect. Where the center of a body is inside the enclosing sphere of another, V is NaN: `.state` refuses it,
    and a step reports `converged=False`; `polyhedron` is exact there. The potential is invariant: P and L are
    conserved; `bodies_energy_momentum` conserves the energy too.

    Args:
        G: the constant of gravity, in units consistent with the other arguments.
        shapes: N bodies of `lieint_jax.shapes`, or their masses where they are spheres or points. The position of a
            body is that of its center of mass; its rotation leads from the axes of its shape to space.
        order: 2, 3 or 4.

    Raises:
        ValueError: there are fewer than two bodies, one is neither a shape nor a mass, a mass is not positive, the
            order is not one of these, or the moments of a shape are not known to this order.

    Source: Hou, Scheeres & Xin 2016, Celest. Mech. Dyn. Astron. 127, the same expansion by inertia integrals; here by
    trace-free moments.
    """
    order = _checks.listed("order", order, (2, 3, 4))
    if not isinstance(shapes, Sequence) or len(shapes) < 2:
        raise ValueError(f"shapes must be a list of two or more shapes or masses, got {shapes!r}")
    bodies = [_moments(k, shape, order) for k, shape in enumerate(shapes)]
    masses, second, third, fourth, radii = (jnp.stack(column) for column in zip(*bodies, strict=True))
    return MutualGravity(_checks.real_array("G", G, ()), masses, second, third, fourth, radii, order)


def _moments(k: int, shape: Any, order: int) -> tuple[Array, ...]:
    """The mass, the trace-free moments, those above the order, which are not used, 0, and the radius of a body."""
    radius = None
    if isinstance(shape, Shape):
        mass, radius = shape.mass, shape.radius
        try:
            moments = [shape.moments(n) if n <= order else jnp.zeros((3,) * n, mass.dtype) for n in (2, 3, 4)]
        except ValueError as error:
            raise ValueError(f"gravity to order {order} needs more of shapes[{k}]: {error}") from error
    else:
        mass = _checks.real_array(f"shapes[{k}], if it is not a shape, the mass of a point,", shape, ())
        moments = [jnp.zeros((3,) * n, mass.dtype) for n in (2, 3, 4)]
    if _checks.concrete(mass) and not float(mass) > 0:
        raise ValueError(f"the mass of shapes[{k}] must be positive, got {float(mass)}")
    return mass, *(trace_free(M) for M in moments), jnp.zeros_like(mass) if radius is None else radius


def _times(Q: Array, v: Array) -> Array:
    """Tensors (k, 3, …, 3) contracted with vectors (k, 3) in their last axis."""
    return jnp.sum(Q * v.reshape(v.shape[0], *[1] * (Q.ndim - 2), 3), axis=-1)


def _product(A: Array, B: Array) -> Array:
    return jnp.sum(A[:, :, :, None] * B[:, None], axis=2)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _scale_each(numbers: Array, tensors: Array) -> Array:
    """Each of k tensors times its number."""
    return numbers.reshape(-1, *[1] * (tensors.ndim - 1)) * tensors


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    shapes = [box([0.3, 0.2, 0.1], mass=2.0), ellipsoid([0.2, 0.3, 0.1], mass=1.0)]
    return {"mutual_gravity": partial(mutual_gravity, G=1.3, shapes=shapes, order=4)}
