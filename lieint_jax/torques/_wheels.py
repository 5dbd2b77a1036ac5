"""Reaction and momentum wheels, whose motors may depend on time, attitude, angular velocity and wheel momentum."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, for_each, named, positive, real_array
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import cross
from lieint_jax.core import Converted, Law, Rotation, argument, callable_pytree, pytree, with_fields
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import cut
from lieint_jax.torques._hold import held_in_step, why_not

__all__ = ["Wheels", "body_inertia", "wheels"]


def wheel_axes(axes: ArrayLike) -> Array:
    """Unit vectors (m, 3)."""
    g = _checks.real_array("axes", axes)
    if g.ndim != 2 or g.shape[1] != 3 or not len(g):
        raise ValueError(f"axes must have shape (m, 3), one unit vector for each wheel, got {g.shape}")
    return _checks.unit_vector("axes", g, g.shape)


class Motor(abc.ABC):
    """Motors of wheels that know the length of a step, and so which part of it they act in."""

    @abc.abstractmethod
    def mean(self, rotation: Rotation, h: Array, limit: Array | None) -> Array:
        """The mean torques dh_j/dt of a step, (m,), of motors that give at most the limit."""


@pytree
class Wheels(Law):
    """Wheels inside the body, free or driven by motors: the momentum of body and wheels is conserved to round-off.

    **The body's `inertia` is then that without the wheels' axial parts**, J = J_locked − Σ I_j g_j g_jᵀ, which
    `body_inertia` returns; gravity gradient needs J_locked. The momentum π of the state is ΛJΩ; the
    absolute axial momenta h_j = I_j(σ_j + g_j·Ω) of the wheels are `State.extra["wheels"]`, (m,). The energy contains
    Σ h_j²/2I_j, and the work Σ Δh_j σ̄_j of the motors is counted exactly for every motor law.

    Args:
        axes: g_j in the body, unit vectors, (m, 3).
        inertias: I_j > 0 about the axes, a number or (m,).
        motor: motor(t, q, Ω, h) ↦ the torques dh_j/dt on the wheels, (m,); the body gets the opposite. It is evaluated
            in the middle of a step, at the mean of h; friction in the bearings is a part of it. None for free wheels.
        max_torque: the motors' greatest torque, > 0, a number or (m,), or None.
        max_momentum: the greatest |h_j|, > 0, a number or (m,), or None. A step that it cuts cannot be undone, so a
            scheme with this law is not symmetric.
        speeds: σ_j, the wheels' initial speeds relative to the body, a number or (m,), rad per unit of time.
        period: of a digital controller, > 0: the motor is evaluated at t = 0, period, 2 period, …, at the state of that
            moment, and its torques are held in between, as `State.extra["motors"]`, (m,). Steps are those that
            `sampled` accepts. By default None, a motor without delay.

    Raises:
        ValueError: axes that are not of unit length, shapes that do not agree, numbers out of range, a motor that has
            no such value.

    Source: Hughes 1986, Spacecraft Attitude Dynamics, chapter 3 and 6; the mean torque of a step: this package.
    """

    axes: Converted[Array] = argument(converter=wheel_axes)
    inertias: Converted[Array] = argument(converter=named(real_array, "inertias"))
    motor: Converted[Callable[..., Array] | None] = argument(
        converter=lambda motor: None if motor is None else callable_pytree(motor), default=None
    )
    max_torque: Converted[Array | None] = argument(
        converter=named(real_array, "max_torque", optional=True), default=None
    )
    _: dataclasses.KW_ONLY
    max_momentum: Converted[Array | None] = argument(
        converter=named(real_array, "max_momentum", optional=True), default=None
    )
    speeds: Converted[Array] = argument(converter=named(real_array, "speeds"), default=0.0)
    period: Converted[Array | None] = argument(converter=named(positive, "period", optional=True), default=None)
    key = "wheels"
    internal = True

    def check_fields(self) -> dict[str, Array]:
        """A moment and a speed for each wheel; ValueError if shapes do not agree."""
        m = len(self.axes)
        moments = for_each(positive, "inertias", self.inertias, m)
        speeds = for_each(real_array, "speeds", self.speeds, m).astype(moments.dtype)
        for name, limit in (("max_torque", self.max_torque), ("max_momentum", self.max_momentum)):
            if limit is not None:
                positive(name, limit, (), (m,))
        if self.motor is not None:
            arguments = (jnp.zeros(()), jnp.asarray(so3.identity), jnp.zeros(3), jnp.zeros(m))
            _checks.function("motor", self.motor, "t, q (4,), Omega (3,) and h (m,)", (m,), *arguments)
        return {"inertias": moments, "speeds": speeds}

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.max_momentum is None and self.period is None

    @property
    def implicit(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.motor is not None and self.period is None

    @property
    def held(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return None if self.period is None else "motors"

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """That of `implicit_mean` for motors that look at h at the start of a step."""
        return self.implicit_mean(rotation, inner, inner)

    def implicit_mean(self, rotation: Rotation, inner: Array, after: Array) -> tuple[Array, Array]:
        """T̄ = −κ Ω̄ × h̄_r − Δh_r/Δt with h_r = Σ g_j h_j: then π + Λh_r is conserved."""
        rate, after = self._drive(rotation, inner, after)
        mean = (inner + after) / 2 @ self.axes
        return -rotation.kappa * jnp.stack(cross(rotation.Omega, mean)) - rate @ self.axes, after

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """Σ h_j²/2I_j."""
        return jnp.sum(inner * inner / self.inertias) / 2

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        """Σ Δh_j σ̄_j with the mean relative speed σ̄_j = h̄_j/I_j − g_j·Ω̄: what the motors do, friction included."""
        speed = (inner + after) / 2 / self.inertias - self.axes @ rotation.Omega
        return jnp.sum((after - inner) * speed)

    def inner_rate(self, now: Rotation, inner: Array) -> Array:
        """The motors' torques, 0 where a wheel is at its limit of momentum and is driven beyond it."""
        return self._drive(now, inner, inner)[0]

    def start(self, now: Rotation) -> Array:
        """I_j(σ_j + g_j·Ω), of the relative speeds σ that the law was made with."""
        return self.inertias * (self.speeds + self.axes @ now.Omega)

    def momentum(self, q: Array, inner: PyTree) -> Array:
        """Λh_r."""
        return so3.Ad(q, inner @ self.axes)

    def measured(self, now: Rotation, inner: PyTree) -> Array:
        """The torques of the motors as the controller sees the body and its wheels."""
        return jnp.zeros_like(inner) if self.motor is None else self.motor(now.t, now.q_n, now.Omega, inner)

    def holding(self, held: Array) -> Wheels:
        """Wheels whose motors give the torques held."""
        return with_fields(self, motor=Partial(_constant, held))

    def sample(self, now: Rotation, dt: Array, inner: PyTree, held: Array) -> tuple[Array, Array]:
        """The torques to hold in a step of dt from now, and whether no step of dt passes over a sample."""
        return held_in_step(jnp.asarray(self.period), now.t, dt, self.measured(now, inner), held)

    def refusal(self, t: Array, dt: ArrayLike) -> str:
        """Which steps the law accepts."""
        return why_not("the controller of the wheels", jnp.asarray(self.period), t, dt)

    def _drive(self, rotation: Rotation, h: Array, end: Array) -> tuple[Array, Array]:
        """The mean torque on the wheels in a step, Δh/Δt, (m,), and h after it, within both limits.

        The motor looks at the mean of h and `end`, which the step solves for: it is the h returned.
        """
        if self.motor is None:
            return jnp.zeros_like(h), h
        torque = self._mean_torque(self.motor, rotation, (h + end) / 2)
        after = h + rotation.dt * torque
        if self.max_momentum is None:
            return torque, after
        after = jnp.clip(after, -self.max_momentum, self.max_momentum)
        moves = rotation.dt != 0
        blocked = (jnp.abs(h) >= self.max_momentum) & (h * torque > 0)
        at_once = jnp.where(blocked, 0, torque)
        return jnp.where(moves, (after - h) / jnp.where(moves, rotation.dt, 1), at_once), after

    def _mean_torque(self, motor: Callable[..., Array], rotation: Rotation, h: Array) -> Array:
        """The mean torque of the motors in a step, at these momenta, within their limit, (m,)."""
        if isinstance(motor, Motor):
            return motor.mean(rotation, h, self.max_torque)
        torque = jnp.asarray(motor(rotation.t, rotation.q_mid, rotation.Omega, h))
        return torque if self.max_torque is None else cut(torque, self.max_torque)


def _constant(held: Array, *_: Array) -> Array:
    """A motor that gives the torques held."""
    return held


def body_inertia(locked: ArrayLike, axes: ArrayLike, inertias: ArrayLike) -> Array:
    """J of a body with wheels, without their axial parts: J_locked − Σ I_j g_j g_jᵀ, (3, 3).

    Args:
        locked: the inertia of the body with all wheels at rest in it, (3,) or (3, 3).
        axes, inertias: of the wheels, as in `wheels`.

    Raises:
        ValueError: what remains is not positive definite.
    """
    J = _checks.inertia(locked)
    g = wheel_axes(axes)
    J = jnp.diag(J) if J.ndim == 1 else J
    moments = for_each(real_array, "inertias", inertias, len(g)).astype(J.dtype)
    rest = J - jnp.einsum("j,ji,jk->ik", moments, g, g)
    return _checks.inertia(rest) if concrete(rest) else rest


wheels = Wheels


def _braking(gain: Array, t: Array, q: Array, Omega: Array, h: Array) -> Array:
    """Motors, for the examples."""
    return -gain * h


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    axes = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    motor, limits = Partial(_braking, jnp.array(0.4)), {"max_torque": 0.1, "max_momentum": 0.5}
    inertias = jnp.array([0.05, 0.07])
    given = {"axes": axes, "inertias": inertias, "motor": motor, **limits, "speeds": 1.0}
    return {
        "body_inertia": partial(body_inertia, locked=jnp.array([1.3, 1.7, 2.2]), axes=axes, inertias=inertias),
        "wheels": partial(wheels, **given, period=None),
        "wheels of a digital controller": partial(wheels, **given, period=0.2),
    }
