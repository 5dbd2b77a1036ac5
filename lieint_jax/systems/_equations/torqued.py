"""One rigid body with laws of torque, of constant inertia or of one that changes."""

from __future__ import annotations

import abc
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Flag, Scalar, Time, Vector3
from lieint_jax._numerics.vectors import dot
from lieint_jax.core import Law, Rotation, State, clock, instant, parts
from lieint_jax.groups import so3
from lieint_jax.systems._equations.equation import equation
from lieint_jax.systems._equations.one_body import AbstractBodyInTime, AbstractRotatingBody


class AbstractTorquedBody(AbstractRotatingBody):
    """A rigid body on T*SO(3) with laws of torque: q̇ = ½ q Ω, π̇ = Σ τ_k, with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        torque: a law of torque, or the `LawSum` of several laws.
    """

    noun = "rigid bodies with a torque (systems.torqued_body)"
    torque: Law

    @property
    def laws(self) -> tuple[Law, ...]:
        """The laws one by one, in the order of `State.extra["works"]`."""
        return parts(self.torque)

    def inner(self, state: State, law: Law) -> Array | None:
        """The internal state of a law, or the one that it reads; None if there is none."""
        key = law.key or law.reads
        return None if key is None else self.entry(state, law, key)

    def entry(self, state: State, law: Law, key: str) -> Array:
        """What a law has in `State.extra` under a key; ValueError if a state lacks it."""
        if state.extra is None or key not in state.extra:
            raise ValueError(
                f'{type(law).__name__} has an internal state, State.extra["{key}"]: make the state with '
                f'system.state(...), or give it one with state._replace(extra={{"{key}": …}})'
            )
        return state.extra[key]

    @equation
    def now(self, state: State) -> Rotation:
        """The instant of a state, for laws."""
        Omega = self.angular_velocity(state)
        return Rotation.at_instant(clock(state), state.q, Omega, so3.Ad(state.q, Omega))

    @equation
    def sampled(self, state: State, dt: Array) -> tuple[State, Flag | bool]:
        """The state that a step of dt begins with, after laws have sampled it, and whether they take such a step."""
        now, fits = self.now(state), True
        for law in (law for law in self.laws if law.held):
            key = str(law.held)
            held, fit = law.sample(now, dt, self.inner(state, law), self.entry(state, law, key))
            state, fits = state._replace(extra=(state.extra or {}) | {key: held}), fit & fits
        return state, fits

    def holding(self, state: State, law: Law) -> Law:
        """A law as it acts between samples: with what it holds, if it is a digital controller."""
        return law if law.held is None else law.holding(self.entry(state, law, law.held))

    @equation
    def instant(self, state: State, law: Law) -> tuple[Vector3, Array | None]:
        """The torque of a law at a state, in the axes of its frame, (3,), and the rate of its internal state."""
        Omega = self.angular_velocity(state)
        omega, inner = so3.Ad(state.q, Omega), self.inner(state, law)
        q_half = partial(so3.cayley_increment, state.q)
        torque, rate = instant(
            self.holding(state, law), clock(state), state.q, Omega, omega=omega, inner=inner, q_half=q_half
        )
        return jnp.asarray(torque).astype(state.p.dtype), rate

    def power(self, state: State) -> Scalar:
        """The rate of `State.work`, a scalar: the power of the torques and the rate of the laws' energies."""
        return jnp.sum(self._rates(state)[2])

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q Ω, Στ_k), the rate of the work, and those of the internal states."""
        impulse, rates, powers = self._rates(state)
        extra = jax.tree.map(jnp.zeros_like, state.extra)
        if rates or extra:
            extra = (extra or {}) | rates
        if extra and "works" in extra:
            extra["works"] = powers
        return State(so3.tangent(state.q, self.angular_velocity(state)), impulse, work=jnp.sum(powers), extra=extra)

    def _rates(self, state: State) -> tuple[Array, dict[str, Array], Array]:
        """π̇, the rates of the internal states, and the powers of the laws."""
        Omega, t = self.angular_velocity(state), clock(state)
        omega, q_dot = so3.Ad(state.q, Omega), so3.tangent(state.q, Omega)
        impulse, rates, powers = jnp.zeros_like(state.p), {}, []
        for law in self.laws:
            torque, rate = self.instant(state, law)
            inner = self.inner(state, law)
            if law.key is not None:
                rates[law.key] = rate
            impulse = impulse + (torque if law.frame == "space" else so3.Ad(state.q, torque))
            own = None if law.key is None else inner  # a law that reads another's state has none of its own
            gain = jax.jvp(law.energy, (t, state.q, own), (jnp.ones_like(t), q_dot, rate))[1]
            powers.append(dot(omega if law.frame == "space" else Omega, torque) + gain)
        return impulse, rates, jnp.stack(powers)


class AbstractTorquedBodyInTime(AbstractBodyInTime):
    """A body with laws of torque whose inertia is a function of time: q̇ = ½ q Ω, π̇ = Στ_k.

    Attributes:
        torque: a law of torque, or the `LawSum` of several laws.
    """

    noun = "bodies with a torque whose inertia changes (systems.inertia_in_time)"
    torque: Law

    @property
    def laws(self) -> tuple[Law, ...]:
        """The laws one by one, in the order of `State.extra["works"]`."""
        return parts(self.torque)

    @abc.abstractmethod
    def frozen(self, t: Time, /) -> AbstractTorquedBody:
        """The body whose constant inertia is J(t)."""

    @equation
    def sampled(self, state: State, dt: Array) -> tuple[State, Flag | bool]:
        """That of the frozen body."""
        return self.frozen(clock(state)).sampled(state, dt)
