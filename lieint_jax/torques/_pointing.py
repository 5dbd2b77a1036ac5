"""Control to a frame that moves, such as local vertical: proportional-derivative and sliding-mode laws."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import not_negative, positive
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import cross
from lieint_jax.core import Law, Rotation, callable_pytree, pytree
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import NO_ROTATION, rotation

__all__ = ["Pointing", "Target", "pointing", "sliding_mode"]


class _Error(NamedTuple):
    """The difference of a body from its target, by a quaternion with a scalar part ≥ 0: the short way."""

    scalar: Array
    vector: Array
    velocity: Array  # Ω_e = Ω − Ω_t, in the body, (3,)
    acceleration: Array  # the rate of Ω_t in the body, (3,)


@pytree
class Target:
    """An attitude to point to: a frame, and the attitude of the body in it."""

    frame: Any  # a unit quaternion, or t ↦ one, perhaps with a method `angular_velocity(t)` in the axes of the frame
    offset: Array  # the attitude of the body in the frame, a unit quaternion

    def error(self, t: Array, q: Array, Omega: Array, accelerates: bool = True) -> _Error:
        """How a body at q with Ω differs from the target at time t; its acceleration is 0 if it is not asked for."""
        if not callable(self.frame):
            e = self._short(self.frame, q)
            return _Error(e[0], e[1:], Omega, jnp.zeros_like(Omega))
        e = self._short(self._attitude(t), q)
        if not accelerates:
            return _Error(e[0], e[1:], Omega - so3.Ad_star(e, self._velocity(t)), jnp.zeros_like(Omega))
        velocity, rate = jax.jvp(self._velocity, (t,), (jnp.ones_like(t),))
        target = so3.Ad_star(e, velocity)
        slip = Omega - target
        return _Error(e[0], e[1:], slip, so3.Ad_star(e, rate) - jnp.stack(cross(slip, target)))

    def _short(self, frame: Array, q: Array) -> Array:
        """The quaternion from the body to its target, with a scalar part ≥ 0."""
        e = so3.multiply(so3.inverse(so3.multiply(frame, self.offset)), q)
        return jnp.where(e[0] < 0, -e, e)

    def _attitude(self, t: Array) -> Array:
        """The frame's quaternion, normalized: the values of a function were not checked."""
        return so3.normalize(jnp.asarray(self.frame(t)))

    def _velocity(self, t: Array) -> Array:
        """Ω_t in the axes of the target, (3,)."""
        if hasattr(self.frame, "angular_velocity"):
            velocity = self.frame.angular_velocity(t)
        else:
            q, rate = jax.jvp(self._attitude, (t,), (jnp.ones_like(t),))
            velocity = so3.body_velocity(q, rate)
        return so3.Ad_star(self.offset, velocity)


def _target(frame: Any, offset: ArrayLike) -> Target:
    mounted = rotation("offset", offset)
    if callable(frame):
        _checks.function("frame", frame, "the time t", (4,), jnp.zeros(()))
        return Target(callable_pytree(frame), mounted)
    return Target(rotation("frame", frame), mounted)


def _feedforward(J: Array | None, Omega: Array, acceleration: Array) -> Array:
    """Ω × JΩ + J·acceleration, or 0 without J."""
    if J is None:
        return jnp.zeros_like(Omega)
    S = vectors.symmetric(J)
    return jnp.stack(cross(Omega, S @ Omega) + S @ acceleration)


@pytree
class Pointing(Law):
    """T = −k e − c Ω_e + feed-forward, in the body. Made by `pointing`."""

    target: Target
    gain: Array
    damping: Array
    inertia: Array | None

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law at the middle of the step."""
        error = self.target.error(rotation.t, rotation.q_mid, rotation.Omega, self.inertia is not None)
        wanted = -self.gain * error.vector - self.damping * error.velocity
        return wanted + _feedforward(self.inertia, rotation.Omega, error.acceleration), inner


def pointing(
    frame: Any,
    gain: ArrayLike,
    damping: ArrayLike,
    inertia: ArrayLike | None = None,
    *,
    offset: ArrayLike = NO_ROTATION,
) -> Pointing:
    """Proportional-derivative control to a frame that may move, such as `orbits.lvlh(orbit)`: T = −k e − c Ω_e.

    e is the vector part of the error's quaternion with a scalar part ≥ 0, so the body rotates by the short way; at an
    error of exactly 180° the torque jumps. As a law it is an ideal actuator; `wheel_motor` and `torquers` give it to
    wheels and to torquers. For a fixed target `pd_quaternion` and `pd_trace` have a potential.

    Args:
        frame: the attitude to point to: a unit quaternion or a scipy `Rotation`, or t ↦ a quaternion, which is
            normalized. If it has a method `angular_velocity(t)`, in its own axes, that is used, else the derivative of
            the quaternion.
        gain: k ≥ 0, a torque, a number or (3,): small errors swing with √(k/2J).
        damping: c ≥ 0, torque × time, a number or (3,).
        inertia: J, (3,) or (3, 3), to add Ω × JΩ and J times the acceleration of the frame: the error then tends to 0
            on a moving frame too; without it an error of the order of the missing torque over k remains.
        offset: the attitude of the body in the frame.

    Raises:
        ValueError: a frame that is neither, negative gains, bad inertia, an offset that is no unit quaternion.

    Source: Wie 2008, Space Vehicle Dynamics and Control, 7.3.
    """
    return Pointing(
        _target(frame, offset),
        not_negative("gain", gain, (), (3,)),
        not_negative("damping", damping, (), (3,)),
        None if inertia is None else _checks.inertia(inertia),
    )


@pytree
class SlidingMode(Law):
    """T = Ω × JΩ + J(Ω̇_t − λė − k sat(s/φ)), s = Ω_e + λe, in the body. Made by `sliding_mode`."""

    target: Target
    inertia: Array
    slope: Array
    rate: Array
    layer: Array

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law at the middle of the step."""
        Omega = rotation.Omega
        error = self.target.error(rotation.t, rotation.q_mid, Omega)
        turned = jnp.stack(cross(error.vector, error.velocity))
        drift = (error.scalar * error.velocity + turned) / 2  # ė
        s = error.velocity + self.slope * error.vector
        wanted = error.acceleration - self.slope * drift - self.rate * jnp.clip(s / self.layer, -1, 1)
        return _feedforward(self.inertia, Omega, wanted), inner


def sliding_mode(
    frame: Any,
    inertia: ArrayLike,
    slope: ArrayLike,
    rate: ArrayLike,
    *,
    layer: ArrayLike,
    offset: ArrayLike = NO_ROTATION,
) -> SlidingMode:
    """Sliding-mode control to a frame that may move: s = Ω_e + λe falls to 0 at the rate k, then the error as e^(−½λt).

    With the true inertia ṡ = −k sat(s/φ), whatever the motion. A wrong one, and torques below kJ, are tolerated.

    Args:
        frame: as in `pointing`.
        inertia: J, (3,) or (3, 3), as assumed by the controller.
        slope: λ > 0, 1 / time.
        rate: k > 0, an angular acceleration, a number or (3,).
        layer: φ > 0, an angular velocity: the boundary layer within which the law is linear, against chatter. Steps
            must resolve φ/k.
        offset: the attitude of the body in the frame.

    Raises:
        ValueError: a frame that is neither, bad inertia, numbers that are not positive, no unit quaternion.

    Source: Vadali 1986, J. Guid. Control Dyn. 9; Crassidis & Markley 1996, J. Guid. Control Dyn. 19.
    """
    return SlidingMode(
        _target(frame, offset),
        _checks.inertia(inertia),
        positive("slope", slope),
        positive("rate", rate, (), (3,)),
        positive("layer", layer),
    )


def _rotating_frame(velocity: Array, t: Array) -> Array:
    """A frame that rotates about a fixed axis, for the examples."""
    return so3.exp(velocity * t)


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    J, offset = jnp.array([1.3, 1.7, 2.2]), jnp.array([0.8, -0.3, 0.4, 0.2]) / jnp.sqrt(0.93)
    frame = Partial(_rotating_frame, jnp.array([0.3, -0.5, 0.7]))
    return {
        "pointing": partial(pointing, frame=frame, gain=0.3, damping=0.2, inertia=J, offset=offset),
        "sliding_mode": partial(sliding_mode, frame=frame, inertia=J, slope=0.7, rate=0.2, layer=0.4, offset=offset),
    }
