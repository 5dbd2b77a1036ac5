"""A gyrostat whose rotor is driven by a motor, which exchanges momentum between body and rotor."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import MomentumMap, Scalar, Time, Vector3
from lieint_jax.core import Converted, State, argument, callable_pytree, clock, from_fields, pytree
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractDrivenGyrostat
from lieint_jax.systems._gyrostat import Gyrostat
from lieint_jax.systems._shared.arguments import check_timed, explained, timed
from lieint_jax.systems._shared.body import as_inertia

__all__ = ["DrivenGyrostat", "SpinUpMotor", "driven_gyrostat"]


@pytree
class DrivenGyrostat(AbstractDrivenGyrostat):
    """A rigid body with a rotor that a motor accelerates.

    H = ½(Π − h_r)·J⁻¹(Π − h_r) as in `gyrostat`, ḣ_r = τ(t), Ḣ = −Ω·τ: the motor's torque τ acts on the rotor, −τ on
    the body, so π and H − W are conserved. With J and h_r as in `gyrostat` for a rotor that spins freely on its
    bearings, τ is the torque about its axis times its axis. H does not contain the energy of the rotor's spin: the
    total work of the motor is H − H₀ plus the change of |h_r|²/2I.

    Args:
        inertia: principal moments, shape (3,), or a symmetric tensor in body axes, shape (3, 3); without the rotor's
            moment about its axis.
        motor: τ, a function of the time t, a scalar, with values (3,) in the body: a smooth JAX function. Parameters to
            be differentiated or batched go into a `jax.tree_util.Partial`, or any pytree that can be called.

    Raises:
        ValueError: a bad inertia; `motor` is not a function of t with values (3,).

    Source: Hughes 1986, Spacecraft Attitude Dynamics.

    Example:
        >>> satellite = driven_gyrostat([1.0, 2.0, 3.0], lambda t: jnp.array([0.1, 0.0, 0.0]))
        >>> state = satellite.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0], work=0.0)
        >>> satellite.vector_field(state).extra["rotor"].tolist()
        [0.1, 0.0, 0.0]
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    motor: Converted[Callable[[Array], Array]] = argument(converter=callable_pytree)

    def check_fields(self) -> None:
        """Raise ValueError if the motor is no function of time."""
        if not callable(self.motor):
            raise ValueError(f"motor must be a function of the time t with values (3,), got {self.motor!r}")
        _checks.function("motor", self.torque, "the time t", (3,), jnp.zeros((), self.inertia.dtype))

    @property
    def initial_extra(self) -> dict[str, Array]:
        """The rotor's momentum, which is zero at rest."""
        return {"rotor": jnp.zeros(3, self.inertia.dtype)}

    @explained
    def state(
        self,
        attitude: _checks.Attitude = (1.0, 0.0, 0.0, 0.0),
        *,
        angular_velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
        rotor: ArrayLike = (0.0, 0.0, 0.0),
        t: ArrayLike = 0.0,
        work: ArrayLike | None = None,
    ) -> State:
        """The state of an attitude, one of three ways to give the motion, and the rotor.

        Args:
            attitude: as in `rigid_body`.
            angular_velocity: body angular velocity Ω, radians per unit time, shape (3,).
            body_momentum: Π = JΩ + h_r, shape (3,).
            spatial_momentum: π = ΛΠ, shape (3,).
            rotor: h_r in the body, shape (3,).
            t: the time of the state, a scalar; by default 0.
            work: the work of the motor so far, a scalar, such as 0, to which steps add; None if it is not tracked.

        Raises:
            ValueError: as in `rigid_body`; a rotor of another shape; a time or a work that is not a scalar; a NaN.
        """
        h = _checks.real_array("rotor", rotor, (3,), like=self.inertia)
        motion = {"body_momentum": body_momentum, "spatial_momentum": spatial_momentum}
        made = self.with_rotor(h).state(attitude, angular_velocity=angular_velocity, **motion)
        return timed(made, t, work)._replace(extra={"rotor": h.astype(made.p.dtype)})

    def rotor(self, state: State) -> Vector3:
        """h_r in the body, shape (3,)."""
        if state.extra is None or "rotor" not in state.extra:
            raise ValueError(
                "the rotor is driven, so the state needs its momentum in state.extra: make it with "
                'system.state(..., rotor=(0, 0, 0)), or give it one with state._replace(extra={"rotor": …})'
            )
        return state.extra["rotor"]

    def torque(self, t: Time) -> Vector3:
        """τ(t), the torque of the motor on the rotor, in the body, shape (3,); −τ acts on the body."""
        return jnp.asarray(self.motor(t), jnp.result_type(t))

    def with_rotor(self, rotor: Vector3) -> Gyrostat:
        """The gyrostat with the constant rotor momentum `rotor`: this one, frozen at one time."""
        return from_fields(Gyrostat, inertia=self.inertia, rotor=rotor)

    def energy(self, state: State) -> Scalar:
        """½(Π − h_r)·J⁻¹(Π − h_r); energy less work is conserved."""
        return self.with_rotor(self.rotor(state)).energy(state)

    def momentum(self, state: State) -> MomentumMap:
        """The momentum map of rotations in space: π itself, of body and rotor together, shape (3,)."""
        return state.p

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or the motor has no value at its time."""
        h = _checks.real_array('state.extra["rotor"]', self.rotor(state), (3,))
        self.with_rotor(h).check(state)
        check_timed(state)
        _checks.real_array(f"the motor's torque at t = {state.t}", self.torque(clock(state)), (3,))


@pytree
class SpinUpMotor:
    """A motor that smoothly increases the rotor's momentum by `momentum`: τ ∝ 1 − cos(2πt/duration).

    Attributes:
        momentum: the change of the rotor's momentum, (3,).
        duration: how long the motor is on, from t = 0.
    """

    momentum: Array
    duration: Array

    def __call__(self, t: Time) -> Vector3:
        phase = 2 * math.pi * jnp.clip(t / self.duration, 0, 1)
        return self.momentum / self.duration * (1 - jnp.cos(phase))


driven_gyrostat = DrivenGyrostat
PROPERTIES = SystemProperties(
    name="driven_gyrostat",
    models="a rigid body with a rotor that a motor drives",
    phase_space="T*SO(3): unit quaternion, π; the rotor's momentum in extra",
    conserves=("energy less work", "momentum", "Casimirs"),
    momentum="π in space, with the rotor",
    sizes=(3,),
    aliases=("spin-up of a dual-spin satellite",),
    source="Hughes 1986, Spacecraft Attitude Dynamics",
)


def examples() -> dict[str, tuple[DrivenGyrostat, State, float]]:
    """The spin-up of the momentum wheel of a tumbling satellite."""
    motor = SpinUpMotor(jnp.array([0.0, 0.0, 1.5]), jnp.array(4.0))
    satellite = driven_gyrostat([1.0, 2.0, 3.0], motor)
    state = satellite.state(angular_velocity=[0.2, 0.5, -0.3], rotor=[0.0, 0.1, 0.0], work=0.0)
    return {"spin_up": (satellite, state, 0.05)}
