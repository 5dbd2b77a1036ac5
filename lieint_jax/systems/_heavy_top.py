"""Heavy tops: a rigid body with one point fixed, under gravity (Section 4)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import elliptic, vectors
from lieint_jax._numerics.arrays import Scalar, Time, Vector3
from lieint_jax.core import PotentialWithGradient, State, System, pytree, static
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._pendulum import Pendulum
from lieint_jax.systems._potential_top import PotentialTop, potential_top

__all__ = [
    "LinearPotential",
    "heavy_top",
    "is_lagrange_top",
    "kovalevskaya_integral",
    "lagrange_motion",
    "pendulum_as_top",
]

_ROUNDING = 4096  # largest difference of equal numbers, in units of their rounding


@pytree
class LinearPotential(PotentialWithGradient):
    """Ṽ(Γ) = E·Γ: uniform gravity, E the weight times the center of mass in the body."""

    weight: Array
    linear: bool = static(default=True)

    def __call__(self, Gamma: Vector3, t: Time | None = None) -> Scalar:
        del t  # there for driven tops
        return vectors.dot(self.weight, Gamma)

    def gradient(self, Gamma: Vector3, t: Time | None = None) -> Vector3:
        """E."""
        del Gamma, t
        return self.weight

    def discrete_gradient(self, a: Vector3, b: Vector3, t: Time | None = None) -> Vector3:
        """E, for any a and b."""
        del a, b, t
        return self.weight


def heavy_top(inertia: ArrayLike, weight: ArrayLike, axis: ArrayLike = (0.0, 0.0, 1.0)) -> PotentialTop:
    """A heavy rigid body with a fixed point: V = γ·ΛE. Its motion conserves energy and γ·π.

    Args:
        inertia: about the fixed point: principal moments (3,) or a symmetric tensor (3, 3).
        weight: E in the body, shape (3,): weight times the vector from the fixed point to the center of mass.
        axis: γ in space, shape (3,): upwards.

    Raises:
        ValueError: as in `potential_top`.

    Source: Lewis & Simo 1994, Section 4; Whittaker, Analytical Dynamics, §71–72.

    Example:
        >>> top = heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, 20.0])
        >>> float(top.energy(top.state(angular_velocity=[0.0, 0.0, 50.0])))
        1270.0
    """
    like = _checks.inertia(inertia)
    return potential_top(inertia, LinearPotential(_checks.real_array("weight", weight, (3,), like=like)), axis)


def lagrange() -> tuple[PotentialTop, State]:
    """The fast symmetric top of Simo & Wong 1991, Int. J. Numer. Methods Eng. 31: J = (5, 5, 1), Mgl = 20, spin 50."""
    top = heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, 20.0])
    return top, top.state(so3.exp(jnp.array([0.3, 0.0, 0.0])), angular_velocity=[0.0, 0.0, 50.0])


class LagrangeMotion(NamedTuple):
    """The motion of the axis of a symmetric top.

    Attributes:
        nutation_period: time from one lowest inclination to the next; if there is no nutation, that of a small one.
        precession_rate: mean angular velocity about γ.
        inclination: the least and the greatest angle between γ and the axis to the center of mass, shape (2,).
    """

    nutation_period: Array
    precession_rate: Array
    inclination: Array


def lagrange_motion(top: PotentialTop, state: State) -> LagrangeMotion:
    """Nutation and precession of Lagrange's top, J₁ = J₂ and E along the third axis, from its integrals.

    With u the cosine of the inclination, u̇² = (a − αu)(1 − u²) − (b − cu)² = α(u − u₁)(u − u₂)(u − u₃), and the angle
    of precession has the rate (b − cu)/(1 − u²), so both are complete elliptic integrals, of the first and the third
    kind. The result is right to about 1e-13, except for tops that pass close to γ or −γ, and NaN for a sleeping top.

    Raises:
        ValueError: another top, see `is_lagrange_top`. If its numbers are traced, this is not checked.

    Source: Whittaker, Analytical Dynamics, §71–72.
    """
    potential = top.potential
    if not isinstance(potential, LinearPotential) or (_checks.concrete(top) and not is_lagrange_top(top)):
        raise ValueError(
            f"a closed form is known for J₁ = J₂ and the weight along the third axis, got {top!r}; measure.nutation "
            "measures the motion of any heavy top"
        )
    J, size = vectors.symmetric(top.inertia), vectors.norm(top._axis)
    E = potential.weight[2]
    Pi = top.body_momentum(state)
    spin = jnp.sign(E) * Pi[2]
    alpha = 2 * jnp.abs(E) * size / J[0]
    a = (2 * top.energy(state) - Pi[2] ** 2 / J[2]) / J[0]
    b, c = vectors.dot(top._axis, state.p) / (size * J[0]), spin / J[0]
    u1, u2, u3 = _real_roots(-(a + c * c) / alpha, 2 * b * c / alpha - 1, (a - b * b) / alpha)
    m1, swing = (u3 - u2) / (u3 - u1), u2 - u1
    K, slow = elliptic.quarter_period(m1), 4 / jnp.sqrt(alpha * (u3 - u1))

    def third_kind(n: Array) -> Array:
        """Π(n, m). Its R_J has p = 1 − n < m1 < 1 or p > 1: (p − x)(p − y)(p − z) > 0, as `carlson_rj` needs."""
        return K + n / 3 * elliptic.carlson_rj(jnp.zeros_like(K), jnp.sqrt(m1), jnp.ones_like(K), 1 - n)

    up, down = (b - c) / (1 - u1) * third_kind(swing / (1 - u1)), (b + c) / (1 + u1) * third_kind(-swing / (1 + u1))
    period, turned = slow * K, slow * (up + down) / 2
    return LagrangeMotion(period, turned / period, jnp.arccos(jnp.clip(jnp.stack([u2, u1]), -1, 1)))


def is_lagrange_top(top: PotentialTop) -> bool:
    """Whether a heavy top is Lagrange's, whose motion is `lagrange_motion`: J₁ = J₂ and E along the third axis.

    Args:
        top: a top whose numbers are known; those that differ by rounding are equal.
    """
    if not isinstance(top.potential, LinearPotential):
        return False
    J, E = np.asarray(top.inertia), np.asarray(top.potential.weight)
    J, tolerance = np.diag(J) if J.ndim == 1 else J, _ROUNDING * np.finfo(J.dtype).eps
    symmetric = max(abs(J[0, 0] - J[1, 1]), abs(J - np.diag(np.diag(J))).max()) <= tolerance * J.max()
    return bool(symmetric and abs(E[:2]).max() <= tolerance * abs(E[2]))


def pendulum_as_top(bob: Pendulum, state: State) -> tuple[PotentialTop, State]:
    """A pendulum in a uniform field as Lagrange's top without spin, whose closed form is `lagrange_motion`.

    Its third axis is the bob, Λe₃ = q, Π₃ = q·π = 0. The axis of the top, from which inclinations are measured and
    about which it precesses, is −γ.
    """
    depth = -bob.potential(bob.axis)
    top = heavy_top(jnp.full(3, bob.mass), jnp.array([0.0, 0.0, 1.0]) * depth, -bob.axis)
    return top, State(so3.from_matrix(jnp.stack([*frame(state.q), state.q], axis=1)), state.p)


def _real_roots(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """The roots of u³ + Au² + Bu + C in ascending order, all of them real (Viète)."""
    p, q = (A * A - 3 * B) / 9, (A * (2 * A * A - 9 * B) + 27 * C) / 54
    third = jnp.arccos(jnp.clip(q / jnp.sqrt(p) ** 3, -1, 1)) / 3
    least, greatest, middle = (-2 * jnp.sqrt(p) * jnp.cos(third + k * 2 * jnp.pi / 3) - A / 3 for k in range(3))
    return least, middle, greatest


def kovalevskaya() -> tuple[PotentialTop, State]:
    """Kovalevskaya 1889, Acta Math. 12: J = (2, 2, 1), the center of mass in the equator; a fourth integral."""
    top = heavy_top([2.0, 2.0, 1.0], [1.0, 0.0, 0.0])
    return top, top.state(so3.exp(jnp.array([0.4, 0.9, -0.2])), angular_velocity=[0.3, 0.7, 0.9])


def kovalevskaya_integral(top: PotentialTop, state: State) -> Scalar:
    """|(Ω₁ + iΩ₂)² − E₁(Γ₁ + iΓ₂)/J₃|², constant for J₁ = J₂ = 2J₃ and E = (E₁, 0, 0)."""
    Omega, Gamma = top.angular_velocity(state), top.Gamma(state)
    assert isinstance(top.potential, LinearPotential)
    c = top.potential.weight[0] / vectors.symmetric(top.inertia)[2]
    real = Omega[0] ** 2 - Omega[1] ** 2 - c * Gamma[0]
    imaginary = 2 * Omega[0] * Omega[1] - c * Gamma[1]
    return real**2 + imaginary**2


def asymmetric() -> tuple[PotentialTop, State]:
    """A heavy body of three moments, its center of mass off every axis: not integrable (Ziglin 1982), and chaotic here.

    Studied by Galgani, Giorgilli & Strelcyn 1981, Nuovo Cimento B 61.
    """
    top = heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])
    return top, top.state(so3.exp(jnp.array([1.2, 0.5, -0.2])), angular_velocity=[0.4, 0.9, 0.6])


PROPERTIES = SystemProperties(
    name="heavy_top",
    models="a rigid body with a fixed point, under gravity",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy", "momentum"),
    momentum="γ·π about the vertical",
    sizes=(1,),
    aliases=("Lagrange's top", "Kovalevskaya's top", "Euler–Poisson equations"),
    source="Lewis & Simo 1994, Section 4; Whittaker, §71–72",
)


def examples() -> dict[str, tuple[System, State, float]]:
    """Lagrange's top, Kovalevskaya's, and an asymmetric one."""
    return {
        "lagrange": (*lagrange(), 0.01),
        "kovalevskaya": (*kovalevskaya(), 0.05),
        "asymmetric_top": (*asymmetric(), 0.05),
    }
