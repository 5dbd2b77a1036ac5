"""One rigid body with an attitude q and a spatial momentum π, on which no torque acts: free, or with a rotor."""

from __future__ import annotations

import abc

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import Matrix3, Time, Vector3
from lieint_jax._numerics.vectors import dot, symmetric
from lieint_jax.core import PhaseSpace, State, clock
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup
from lieint_jax.systems._equations.equation import Equations, equation

_PHASE_SPACE = CotangentGroup(so3)


class AbstractRotatingBody(Equations):
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


class AbstractBodyInTime(Equations):
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
    def frozen(self, t: Time, /) -> AbstractRotatingBody:
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
