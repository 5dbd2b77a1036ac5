"""A rigid body with laws of torque: of time, attitude, angular velocity, and internal states such as wheels."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, torques
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import MomentumMap, Scalar, Time, Vector3
from lieint_jax._xla import compiled
from lieint_jax.capabilities import AbstractTorquedBody
from lieint_jax.core import Law, Rotation, State, System, as_law, clock, labels, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._shared.body import TimedBody

__all__ = ["TorquedBody", "torqued_body"]


@pytree
class TorquedBody(TimedBody, AbstractTorquedBody):
    """H = ½ Π·J⁻¹Π + ΣE_k: Λ̇ = ΛΩ̂, π̇ = Στ_k. Made by `torqued_body`."""

    inertia: Array
    torque: Law

    @property
    def frame(self) -> str:
        """The axes of `torque_at`: those of the only law, "body" for several."""
        return self.laws[0].frame if len(self.laws) == 1 else "body"

    def terms(self) -> dict[str, System]:
        """The body with one of the laws each, of those without an internal state."""
        named = zip(labels(self), self.laws, strict=True)
        plain = {name: law for name, law in named if law.key is None and law.reads is None}
        return {f"the torque {name}": dataclasses.replace(self, torque=law) for name, law in plain.items()}

    @property
    def initial_extra(self) -> dict[str, Array] | None:
        """The internal states of the laws at rest, by their keys; None if there are none."""
        zero = jnp.zeros((), self.inertia.dtype)
        q, rest = jnp.asarray(so3.identity, zero.dtype), jnp.zeros(3, zero.dtype)
        return self._starts(Rotation.at_instant(zero, q, rest, rest)) or None

    def state(self, *arguments: Any, works: bool = False, **options: Any) -> State:
        state = super().state(*arguments, **options)
        extra = jax.tree.map(lambda x: x.astype(state.p.dtype), self._starts(self.now(state)))
        if works:
            extra["works"] = jnp.zeros(len(self.laws), state.p.dtype)
            state = state if state.work is not None else state._replace(work=jnp.zeros((), state.p.dtype))
        return state._replace(extra=extra) if extra else state

    state.__doc__ = f"""{TimedBody.state.__doc__}
        The internal states of the laws begin as each law defines: a damper rotates with the body, wheels have the
        speeds that they were made with. With `works=True`, `State.extra["works"]` counts the work of each law, (number
        of laws,), in their order.
        """

    def torque_at(self, state: State) -> Vector3:
        """The torque of all laws, (3,), in the axes of `frame`."""
        torques = [self.instant(state, law)[0] for law in self.laws]
        if len(self.laws) == 1:
            return torques[0]
        pairs = zip(self.laws, torques, strict=True)
        return sum((x if law.frame == "body" else so3.Ad_star(state.q, x) for law, x in pairs), jnp.zeros_like(state.p))

    def energy(self, state: State) -> Scalar:
        """½ Π·J⁻¹Π plus the energies of the laws: potentials and energies of internal states."""
        t = clock(state)
        laws = [law.energy(t, state.q, self.inner(state, law)) for law in self.laws]
        return sum(laws, self.kinetic_energy(state))

    def momentum(self, state: State) -> MomentumMap:
        """π plus the momenta of dampers and wheels, (3,), if all laws are internal; otherwise (0,)."""
        if not all(law.internal for law in self.laws):
            return state.p[:0]
        return sum((law.momentum(state.q, self.inner(state, law)) for law in self.laws), state.p)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or has no time."""
        super().check(state)
        clock(state)
        rest = self.initial_extra or {}
        for law in self.laws:
            for key in (key for key in (law.key, law.held) if key is not None and key in rest):
                _checks.real_array(f'state.extra["{key}"]', self.entry(state, law, key), rest[key].shape)
        if concrete(self, state) and not np.all(np.isfinite(torque := _torque_at(self, state))):
            Omega = self.angular_velocity(state)
            velocity = so3.Ad(state.q, Omega) if self.frame == "space" else Omega
            raise ValueError(
                f"the torque must be finite, got {np.asarray(torque)} at t = {float(clock(state)):g}, "
                f"q = {np.asarray(state.q)}, ω = {np.asarray(velocity)} in the {self.frame}: fix the law"
            )

    def _starts(self, now: Rotation) -> dict[str, Array]:
        found = {law.key: law.start(now) for law in self.laws if law.key is not None}
        found |= {law.held: law.measured(now, law.key and found[law.key]) for law in self.laws if law.held is not None}
        return {key: value for key, value in found.items() if value is not None}


@partial(compiled, once=True)
def _torque_at(body: TorquedBody, state: State) -> Vector3:
    return body.torque_at(state)


def torqued_body(inertia: ArrayLike, torque: Any, frame: Literal["body", "space"] | None = None) -> TorquedBody:
    """A rigid body with torques. `schemes.torqued_midpoint` integrates it and accounts for the work of each law
    exactly.

    Args:
        inertia: principal moments (3,) or a symmetric tensor in body axes (3, 3); with wheels, without their moments of
            inertia about their axes (`torques.wheels`).
        torque: a law of `lieint_jax.torques`, a sum of laws, or a JAX function (t, q, ω) ↦ (3,) of time, attitude
            quaternion and angular velocity, in the axes of `frame`, as ω is. Parameters to be differentiated or batched
            go into a `jax.tree_util.Partial`, or into a custom law: see `torques.Law`.
        frame: "body" or "space", the axes of a function; a law has its own.

    Raises:
        ValueError: bad inertia; the torque is not a function with a value (3,); `frame` is not that of the law.

    Source: Hughes 1986, Spacecraft Attitude Dynamics.

    Example:
        >>> import lieint_jax as li
        >>> body = torqued_body([1.0, 2.0, 3.0], li.torques.viscous(0.1))
        >>> state = body.state(angular_velocity=[0.2, 0.0, 1.0], work=0.0)
        >>> run = li.run(li.schemes.torqued_midpoint(body), state, 0.1, 100, progress=False)
        >>> bool(abs(run.energy_error()).max() < 1e-5)  # of H − work
        True
    """
    made = TorquedBody(_checks.inertia(inertia), _law(torque, frame))
    _check_torque(made)
    return made


def _law(torque: Any, frame: str | None) -> Law:
    """The torque as a law."""
    own = getattr(torque, "frame", None)
    if frame not in (None, "body", "space") or own not in (None, frame or own) or own not in (None, "body", "space"):
        allowed = f'"{own}", the axes of {type(torque).__name__}' if own in ("body", "space") else '"body" or "space"'
        raise ValueError(f"frame must be {allowed}, got {frame or own!r}")
    return as_law(torque, frame or own or "body")


def _check_torque(body: TorquedBody) -> None:
    """Raise ValueError if a law has no real value of shape (3,)."""
    keys = [law.key for law in body.laws]
    for law in body.laws:
        if law.reads is not None and law.reads not in keys:
            raise ValueError(
                f'{type(law).__name__} reads State.extra["{law.reads}"], and no law has it: add the law with that '
                "internal state, such as torques.wheels"
            )
    number, q, vector = (jax.ShapeDtypeStruct(shape, body.inertia.dtype) for shape in ((), (4,), (3,)))
    for law in body.laws:

        def value(t: Array, q: Array, omega: Array, law: Law = law) -> Array:
            now = Rotation(t, t, q, q, q, omega, t, omega, omega)
            key = law.key or law.reads
            return law.mean(now, None if key is None else (body.initial_extra or {})[key])[0]

        try:
            found = jax.eval_shape(value, number, q, vector)
        except (TypeError, IndexError, ValueError, AttributeError) as error:
            raise ValueError(f"torque fails as a function of t (), q (4,) and omega (3,): {error}") from error
        kinds = jnp.floating, jnp.integer
        array = isinstance(found, jax.ShapeDtypeStruct)
        if not array or found.shape != (3,) or not any(jnp.issubdtype(found.dtype, kind) for kind in kinds):
            given = f"shape {found.shape} and dtype {found.dtype}" if array else f"{found!r}"
            raise ValueError(f"torque must return an array of real numbers of shape (3,), got {given}")


def _dipole_field(t: Time) -> Vector3:
    """The field of a dipole along a polar orbit, in the dipole's unit: (3 sin 2u, 0, 3 cos 2u + 1)/2 with u = t/10."""
    return jnp.stack([1.5 * jnp.sin(t / 5), jnp.zeros_like(t), 1.5 * jnp.cos(t / 5) + 0.5])


PROPERTIES = SystemProperties(
    name="torqued_body",
    models="a rigid body with laws of torque",
    phase_space="T*SO(3): unit quaternion, π; internal states in extra",
    conserves=("energy less work", "momentum (laws that act inside only)"),
    momentum="π with dampers and wheels, or none",
    sizes=(3, 0),
    aliases=("attitude dynamics with torques",),
    source="Hughes 1986, Spacecraft Attitude Dynamics",
)


def examples() -> dict[str, tuple[TorquedBody, State, float]]:
    """Magnetic detumbling on a polar orbit, a controlled slew, dampers, a computer, and a satellite with five laws."""
    J, start, Omega = [1.0, 2.0, 2.5], so3.exp(jnp.array([0.9, -1.2, 0.5])), jnp.array([0.3, -0.4, 0.8])
    satellite = torques.total(
        [
            torques.dipole([0.01, 0.0, 0.02], _dipole_field),
            torques.bdot(0.05, _dipole_field, max_dipole=0.1),
            torques.hysteresis([1.0, 0.0, 0.0], 0.02, 0.5, 0.3, field=_dipole_field),
            torques.wheels(jnp.eye(3), 0.05, speeds=[1.0, -2.0, 0.5]),
            torques.viscous(0.001),
        ]
    )
    made = {
        "detumbling": torqued_body(J, torques.bdot(0.05, _dipole_field)),
        "slew": torqued_body(J, torques.pd_quaternion(0.5, 0.8)),
        "damper": torqued_body(J, torques.kane_damper(0.2, 0.1)),
        "eddy_currents": torqued_body(J, torques.eddy_current([0.05, 0.1, 0.2], _dipole_field)),
        "computer": torqued_body(J, torques.sampled(torques.pd_quaternion(0.5, 0.8), 0.1)),
        "satellite": torqued_body(J, satellite),
    }
    return {name: (body, body.state(start, angular_velocity=Omega, work=0.0), 0.05) for name, body in made.items()}
