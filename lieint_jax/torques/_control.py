"""Attitude control to a fixed attitude: proportional-derivative laws."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import Array

from lieint_jax._checks import named, not_negative
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import dot
from lieint_jax.core import Converted, Law, Rotation, argument, pytree
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import NO_ROTATION, rotation

__all__ = ["PDTrace", "pd_quaternion", "pd_trace"]


@pytree
class _ProportionalDerivative(Law):
    """A potential of the attitude and damping, which alone does work."""

    gain: Converted[Array] = argument(converter=named(not_negative, "gain"))
    damping: Converted[Array] = argument(converter=named(not_negative, "damping"))
    target: Converted[Array] = argument(converter=partial(rotation, "target"), default=NO_ROTATION)

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        """−Δt c|Ω̄|²."""
        velocity = rotation.velocity(self.frame)
        return -rotation.dt * self.damping * dot(velocity, velocity)


@pytree
class PDTrace(_ProportionalDerivative):
    """Control to an attitude Λ_d by the potential U = ½k tr(1 − Λ_dᵀΛ) and damping c: τ = −½k vex(ΛΛ_dᵀ) − cω.

    H = T + U decreases by Δt c|ω̄|² in a step. The torque depends on Λ only, so q and −q give the same torque, and the
    body rotates the short way. The torque k sin φ also vanishes at an error of φ = 180°, an unstable equilibrium.

    Args:
        gain: k, a torque, > 0: small errors swing with √(k/J).
        damping: c ≥ 0, torque × time.
        target: Λ_d, a unit quaternion or a scipy `Rotation`.

    Raises:
        ValueError: a negative gain or damping, a target that is no unit quaternion.

    Source: Koditschek 1989, Contemp. Math. 97; the mean torque of a step: this package.
    """

    frame = "space"

    def _error(self, q: Array) -> Array:
        """The quaternion of ΛΛ_dᵀ."""
        return so3.multiply(q, so3.inverse(self.target))

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """−½κk vex(Λ̄Λ_dᵀ) − cω̄, Λ̄ the mean of Λ_n and Λ_{n+1}: ω̄·mean = −ΔU/Δt − c|ω̄|²."""
        a, b = self._error(rotation.q_n), self._error(rotation.q_next)
        pull = -rotation.kappa * self.gain * (a[0] * a[1:] + b[0] * b[1:])
        return pull - self.damping * rotation.omega, inner

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """U = ½k tr(1 − Λ_dᵀΛ) = k(1 − cos φ) of the error's angle φ."""
        e = self._error(q)
        return 2 * self.gain * dot(e[1:], e[1:])


@pytree
class PDQuaternion(_ProportionalDerivative):
    """Control to an attitude by the potential U = 2k(1 − e₀), e = q_d⁻¹q, and damping c: T = −k(e₁, e₂, e₃) − cΩ.

    H = T + U decreases by Δt c|Ω̄|² in a step. The torque k sin ½φ is largest at an error of φ = 180°, but q and −q,
    the same attitude, have different torques: **it unwinds**, that is, from e₀ < 0 the body rotates by more than 180°
    to reach e₀ = 1. Give the state a q with e₀ ≥ 0 for the short way.

    Args:
        gain: k, a torque, > 0: small errors swing with √(k/2J).
        damping: c ≥ 0, torque × time.
        target: q_d, a unit quaternion or a scipy `Rotation`; −q_d is the other way round.

    Raises:
        ValueError: a negative gain or damping, a target that is no unit quaternion.

    Source: Wie & Barba 1985, J. Guid. Control Dyn. 8; unwinding: Bhat & Bernstein 2000, Syst. Control Lett. 39; the
    mean torque of a step: this package.
    """

    def _error(self, q: Array) -> Array:
        """e, the quaternion of Λ_dᵀΛ."""
        return so3.multiply(so3.inverse(self.target), q)

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """−κk(e_n + e_{n+1})/(1 + √(1+|h|²)) − cΩ̄, of the vector parts: Ω̄·mean = −ΔU/Δt − c|Ω̄|²."""
        e = self._error(rotation.q_n)[1:] + self._error(rotation.q_next)[1:]
        weight = rotation.kappa * self.gain / (1 + jnp.sqrt(1 + dot(rotation.h, rotation.h)))
        return -weight * e - self.damping * rotation.Omega, inner

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """U = 2k(1 − e₀) = 4k sin²(φ/4), φ the error's angle from 0 to 360°."""
        return 2 * self.gain * (1 - self._error(q)[0])


pd_trace, pd_quaternion = PDTrace, PDQuaternion


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    target = jnp.array([0.2, 0.4, -0.3, 0.8]) / jnp.sqrt(0.93)
    return {
        "pd_trace": partial(pd_trace, gain=0.3, damping=0.2, target=target),
        "pd_quaternion": partial(pd_quaternion, gain=0.3, damping=0.2, target=target),
    }
