"""A rigid body whose inertia is a given function of time: booms that deploy, fuel that burns; free or with torques."""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import MomentumMap, Scalar, Time, Vector3
from lieint_jax._xla import shapes_now
from lieint_jax.capabilities import AbstractBodyInTime, AbstractFreeBodyInTime, AbstractTorquedBodyInTime
from lieint_jax.core import Law, State, callable_pytree, clock, from_fields, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._rigid_body import RigidBody
from lieint_jax.systems._shared.body import TimedBody
from lieint_jax.systems._torqued_body import TorquedBody, torqued_body
from lieint_jax.torques import thruster

__all__ = ["InertiaInTime", "TorquedInertiaInTime", "inertia_in_time"]

_Inertia = Callable[[Array], Array]


@pytree
class FrozenBody(TimedBody, RigidBody):
    """A free body at one time of an `InertiaInTime`; its states have the time."""


@pytree
class _InTime(AbstractBodyInTime):
    """The states and the energy of a body whose inertia is a function of time."""

    inertia: _Inertia
    rate: _Inertia | None

    @abc.abstractmethod
    def frozen(self, t: Time, /) -> FrozenBody | TorquedBody:
        """The body whose constant inertia is J(t)."""

    def inertia_at(self, t: Time) -> Array:
        """J(t), (3,) or (3, 3)."""
        return _value(self.inertia, t)

    def rate_at(self, t: Time) -> Array:
        """J̇(t), of the shape of J."""
        if self.rate is not None:
            return _value(self.rate, t)
        return jax.jvp(self.inertia_at, (t,), (jnp.ones_like(t),))[1]

    def state(self, *arguments: Any, t: ArrayLike = 0.0, **options: Any) -> State:
        time = _checks.real_array("t", t, ())
        J = self.inertia_at(time)
        _checks.positive_definite(f"the inertia at t = {time}", J)
        return self.frozen(time).state(*arguments, t=time, **options)

    state.__doc__ = TimedBody.state.__doc__

    def rotation_matrix(self, state: State) -> Array:
        """Λ, body to space, shape (3, 3)."""
        return so3.to_matrix(state.q)

    def body_momentum(self, state: State) -> Vector3:
        """Π = Λᵀπ, shape (3,)."""
        return so3.Ad_star(state.q, state.p)

    def energy(self, state: State) -> Scalar:
        """½ Π·J(t)⁻¹Π, plus the energies of the laws."""
        return self.frozen(clock(state)).energy(state)

    def momentum(self, state: State) -> MomentumMap:
        """π, (3,), with the momenta of dampers and wheels; (0,) if a law acts from outside."""
        return self.frozen(clock(state)).momentum(state)

    @property
    def initial_extra(self) -> dict[str, Array] | None:
        """The internal states of the laws at rest, by their keys; None if there are none."""
        return self.frozen(jnp.zeros(())).initial_extra

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or J is not positive definite then."""
        t = clock(state)
        _checks.positive_definite(f"the inertia at t = {t}", self.inertia_at(t))
        self.frozen(t).check(state)


@pytree
class InertiaInTime(_InTime, AbstractFreeBodyInTime):
    """H = ½ Π·J(t)⁻¹Π: Λ̇ = ΛΩ̂, π̇ = 0. Made by `inertia_in_time`."""

    def frozen(self, t: Time) -> FrozenBody:
        return from_fields(FrozenBody, inertia=self.inertia_at(t))


@pytree
class TorquedInertiaInTime(_InTime, AbstractTorquedBodyInTime):
    """H = ½ Π·J(t)⁻¹Π + ΣE_k: Λ̇ = ΛΩ̂, π̇ = Στ_k. Made by `inertia_in_time` with a torque."""

    torque: Law

    def frozen(self, t: Time) -> TorquedBody:
        return TorquedBody(self.inertia_at(t), self.torque)


def inertia_in_time(
    inertia: Callable[[Array], Any], rate: Callable[[Array], Any] | None = None, torque: Any = None
) -> InertiaInTime | TorquedInertiaInTime:
    """A rigid body whose inertia is a function of time: booms that deploy, fuel that burns; free or with torques.

    π is that of a free body, and H − W is conserved, where the work W of what moves the masses has the power −½ Ω·J̇Ω.
    `schemes.so3_midpoint` integrates it, with torques `schemes.torqued_midpoint`. `State.work` counts the work of the
    masses and of the torques; with `state(…, works=True)`, `State.extra["works"]` counts those of the laws one by one.

    The masses move in the body without an angular momentum of their own, as a pair of booms does. Mass that leaves the
    body at r from the center of mass takes its momentum along: add a law of torque for jet damping, the function
    (t, q, Ω) ↦ ṁ r × (Ω × r) with the rate ṁ < 0 of the body's mass.

    Args:
        inertia: J, a JAX function of the time t, a scalar, with values (3,), principal moments, or (3, 3), a symmetric
            tensor in body axes, positive definite: a step in which it is not reports `converged=False`. Parameters to
            be differentiated or batched go into a `jax.tree_util.Partial`.
        rate: J̇, such a function; by default the derivative of J by JAX. Only the vector field needs it.
        torque: as in `torqued_body`, in the body if it is a function; None for a free body.

    Raises:
        ValueError: a function that JAX cannot trace or with values of another shape; a bad torque. `state` raises one
            if J is not positive definite at its time.

    Source: Hughes 1986, Spacecraft Attitude Dynamics; for jet damping: Thomson 1986, Introduction to Space Dynamics.

    Example:
        >>> import lieint_jax as li
        >>> body = inertia_in_time(lambda t: jnp.stack([1.0 + t, 2.0 + t, 2.5 + 0 * t]))
        >>> state = body.state(angular_velocity=[0.2, 0.0, 1.0], work=0.0)
        >>> run = li.run(li.schemes.so3_midpoint(body), state, 0.05, 20, progress=False)
        >>> bool((run.state.p == state.p).all()) and bool(abs(run.energy_error()).max() < 1e-5)
        True
    """
    for name, function in (("inertia", inertia), ("rate", rate)):
        _check(name, function)
    parts = (callable_pytree(inertia), None if rate is None else callable_pytree(rate))
    if torque is None:
        return InertiaInTime(*parts)
    return TorquedInertiaInTime(*parts, torqued_body(jnp.ones(3), torque).torque)


def _value(function: Callable[..., Any], t: Time) -> Array:
    """The tensor at a time, in the type of the time."""
    t = jnp.asarray(t)
    return jnp.asarray(function(t), t.dtype)


def _check(name: str, function: Any) -> None:
    """Raise ValueError unless this is a function of time with values (3,) or (3, 3), or the rate is None."""
    if function is None and name == "rate":
        return
    if not callable(function):
        raise ValueError(
            f"{name} must be a function of the time t with values (3,) or (3, 3), got {function!r}; a body of constant "
            "inertia is systems.rigid_body or systems.torqued_body"
        )
    value, zero = partial(_value, function), jnp.zeros(())
    try:
        shape = shapes_now(value, zero).shape
    except Exception:  # `_checks.function` says what fails
        shape = (3,)
    _checks.function(name, value, "the time t", shape if shape == (3, 3) else (3,), zero)


def _deploying(folded: Array, change: Array, t: Time) -> Vector3:
    """Moments that change smoothly about t = 2, for the examples."""
    return folded + (1 + jnp.tanh(t - 2)) / 2 * change


PROPERTIES = SystemProperties(
    name="inertia_in_time",
    models="a rigid body whose inertia is a function of time",
    phase_space="T*SO(3): unit quaternion, π; internal states in extra",
    conserves=("energy less work", "momentum (laws that act inside only)"),
    momentum="π with dampers and wheels, or none",
    sizes=(3, 0),
    aliases=("deployment of booms", "variable-mass body"),
    source="Hughes 1986, Spacecraft Attitude Dynamics",
)


def examples() -> dict[str, tuple[InertiaInTime | TorquedInertiaInTime, State, float]]:
    """A satellite that deploys booms while it tumbles, and a motor off the axis that burns its fuel."""
    booms = Partial(_deploying, jnp.array([1.0, 1.5, 2.0]), jnp.array([2.0, 0.3, 2.0]))
    fuel = Partial(_deploying, jnp.array([2.0, 1.9, 0.6]), jnp.array([-0.6, -0.6, -0.1]))
    motor = thruster([0.02, 0.05, 0.0], -1.0, 4.0)  # it burns at the start, across which some tests differentiate
    made = {"booms": inertia_in_time(booms), "motor": inertia_in_time(fuel, torque=motor)}
    return {name: (body, body.state(angular_velocity=[0.3, -0.4, 0.8], work=0.0), 0.05) for name, body in made.items()}
