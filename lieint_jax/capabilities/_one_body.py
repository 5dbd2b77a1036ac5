"""One rigid body with an attitude q and a spatial momentum π: free, with a rotor, with torques, or with friction."""

from __future__ import annotations

import abc
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Flag, Matrix3, Scalar, Time, Vector3
from lieint_jax._numerics.vectors import cross, dot, matrix, symmetric, vector
from lieint_jax.capabilities._capability import Capability, equation
from lieint_jax.core import Law, PhaseSpace, Rotation, State, clock, instant, parts
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup, EmbeddedRotations
from lieint_jax.torques import internal_friction

_PHASE_SPACE, _EMBEDDED = CotangentGroup(so3), EmbeddedRotations()


class AbstractRotatingBody(Capability):
    """A rigid body on T*SO(3) without a torque: q̇ = ½ q Ω, π̇ = 0, with JΩ = Π = Λᵀπ (2.12).

    Attributes:
        inertia: J, principal moments (3,) or a symmetric tensor (3, 3).
    """

    inertia: Array

    @property
    def phase_space(self) -> PhaseSpace:
        return _PHASE_SPACE

    def rotation_matrix(self, state: State) -> Matrix3:
        """Λ, body to space, shape (3, 3)."""
        return so3.to_matrix(state.q)

    @equation
    def body_momentum(self, state: State) -> Vector3:
        """Π = Λᵀπ, shape (3,)."""
        return so3.Ad_star(state.q, state.p)

    @equation
    def angular_velocity(self, state: State) -> Vector3:
        """The body angular velocity Ω = J⁻¹Π, shape (3,)."""
        return jnp.stack(symmetric(self.inertia).solve(self.body_momentum(state)))

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q Ω, 0) (2.12)."""
        return State(so3.tangent(state.q, self.angular_velocity(state)), jnp.zeros_like(state.p))


class AbstractFreeBody(AbstractRotatingBody):
    """A torque-free rigid body on T*SO(3): q̇ = ½ q Ω, π̇ = 0 with JΩ = Π = Λᵀπ (2.12).

    Attributes:
        inertia: J, principal moments (3,) or a symmetric tensor (3, 3).
    """

    noun = "free rigid bodies (systems.rigid_body)"
    default_drift = "so3_midpoint"


class AbstractBodyInTime(Capability):
    """A rigid body whose inertia is a function of time: at each time it moves as `frozen`, its present self.

    H − W is conserved, with the power Ẇ = −½ Ω·J̇Ω of what moves the masses, plus that of torques.
    """

    @property
    def phase_space(self) -> PhaseSpace:
        return _PHASE_SPACE

    @abc.abstractmethod
    def inertia_at(self, t: Time, /) -> Array:
        """J(t), principal moments (3,) or a symmetric tensor (3, 3)."""

    @abc.abstractmethod
    def rate_at(self, t: Time, /) -> Array:
        """J̇(t), of the shape of J."""

    @abc.abstractmethod
    def frozen(self, t: Time, /) -> AbstractFreeBody | AbstractTorquedBody:
        """The body whose constant inertia is J(t)."""

    @equation
    def angular_velocity(self, state: State) -> Vector3:
        """The body angular velocity Ω = J(t)⁻¹Π, shape (3,)."""
        return self.frozen(clock(state)).angular_velocity(state)

    @equation
    def vector_field(self, state: State) -> State:
        """That of the frozen body, with −½ Ω·J̇Ω added to the rate of the work."""
        t = clock(state)
        body = self.frozen(t)
        moving, Omega = body.vector_field(state), body.angular_velocity(state)
        power = -dot(Omega, symmetric(self.rate_at(t)) @ Omega) / 2
        return moving._replace(work=power if moving.work is None else power + moving.work)


class AbstractFreeBodyInTime(AbstractBodyInTime):
    """A torque-free body whose inertia is a function of time: q̇ = ½ q Ω, π̇ = 0 with J(t)Ω = Π = Λᵀπ."""

    noun = "free bodies whose inertia changes (systems.inertia_in_time)"

    @abc.abstractmethod
    def frozen(self, t: Time, /) -> AbstractFreeBody:
        """The body whose constant inertia is J(t)."""


class AbstractTorquedBodyInTime(AbstractBodyInTime):
    """The same with laws of torque: q̇ = ½ q Ω, π̇ = Στ_k.

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


class AbstractGyrostat(AbstractRotatingBody):
    """A rigid body with a rotor whose momentum in the body is constant: q̇ = ½ q Ω, π̇ = 0 with JΩ = Π − h_r, Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        rotor: h_r in the body, (3,).
    """

    noun = "gyrostats (systems.gyrostat)"
    default_drift = "exact"
    rotor: Array

    @property
    @abc.abstractmethod
    def free(self) -> AbstractFreeBody:
        """The body of this inertia without a rotor."""

    @equation
    def angular_velocity(self, state: State) -> Vector3:
        """The body angular velocity Ω = J⁻¹(Π − h_r), shape (3,)."""
        return jnp.stack(symmetric(self.inertia).solve(self.body_momentum(state) - self.rotor))


class AbstractDrivenGyrostat(AbstractRotatingBody):
    """A gyrostat whose rotor is driven by a motor of given torque: as `AbstractGyrostat`, with ḣ_r = τ(t).

    h_r is `State.extra["rotor"]`. H − W is conserved, with the work W = −∫Ω·τ dt of the motor.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
    """

    noun = "driven gyrostats (systems.driven_gyrostat)"

    @abc.abstractmethod
    def rotor(self, state: State, /) -> Vector3:
        """h_r in the body, (3,)."""

    @abc.abstractmethod
    def torque(self, t: Time, /) -> Vector3:
        """τ, the torque of the motor on the rotor at time t, in the body, (3,)."""

    @abc.abstractmethod
    def with_rotor(self, rotor: Vector3, /) -> AbstractGyrostat:
        """The gyrostat whose rotor has the constant momentum `rotor`, (3,)."""

    @equation
    def angular_velocity(self, state: State) -> Vector3:
        """The body angular velocity Ω = J⁻¹(Π − h_r), shape (3,)."""
        return self.with_rotor(self.rotor(state)).angular_velocity(state)

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q Ω, 0), ẇork = −Ω·τ, ḣ_r = τ; 0 for other entries of `extra`."""
        turning, torque = super().vector_field(state), self.torque(clock(state))
        still = jax.tree.map(jnp.zeros_like, state.extra)
        work = -dot(self.angular_velocity(state), torque)
        return turning._replace(work=work, extra=still | {"rotor": torque})


class AbstractEmbeddedBody(AbstractRotatingBody):
    """A free rigid body whose attitude Λ may leave SO(3), on L(3) × ℝ³: Λ̇ = ΛΩ̂, π̇ = 0 with JΩ = Π = Λ⁻¹π (2.12).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
    """

    noun = "free rigid bodies with an attitude in L(3) (systems.embedded_body)"

    @property
    def phase_space(self) -> EmbeddedRotations:
        return _EMBEDDED

    def rotation_matrix(self, state: State) -> Matrix3:
        """Λ itself, shape (3, 3): a rotation if the state is on T*SO(3)."""
        return state.q

    @equation
    def body_momentum(self, state: State) -> Vector3:
        """Π = Λ⁻¹π, shape (3,)."""
        return jnp.stack(matrix(state.q).solve(state.p))

    @equation
    def vector_field(self, state: State) -> State:
        """(Λ̇, π̇) = (ΛΩ̂, 0) (2.12)."""
        Omega = self.angular_velocity(state)
        return State(matrix(state.q).times_hat(vector(Omega)).array, jnp.zeros_like(state.p))


class AbstractDampedBody(AbstractRotatingBody):
    """A rigid body on T*SO(3) with internal friction: q̇ = ½ q (Ω + α Π × Ω), π̇ = 0 with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        friction: α, an inverse angular momentum.
    """

    noun = "rigid bodies with internal friction (systems.damped_body)"
    friction: Array

    @equation
    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q (Ω + αΠ × Ω), 0), and −α|Π × Ω|² as the rate of the work."""
        Pi, Omega = self.body_momentum(state), self.angular_velocity(state)
        more = jnp.stack(internal_friction(self.friction, Pi, Omega))
        slip = cross(Pi, Omega)
        q_dot = so3.tangent(state.q, Omega + more)
        return State(q_dot, jnp.zeros_like(state.p), work=-self.friction * dot(slip, slip))


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
