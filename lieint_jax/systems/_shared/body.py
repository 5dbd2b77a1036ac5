"""Base classes that create and evaluate states of a rigid body."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, _free_body
from lieint_jax._checks import concrete
from lieint_jax._free_body import Periods
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import MomentumMap, Quaternion, Scalar, Vector3
from lieint_jax._xla import compiled
from lieint_jax.core import State
from lieint_jax.groups import so3
from lieint_jax.systems._equations import AbstractRotatingBody
from lieint_jax.systems._shared.arguments import check_timed, explained, timed

as_inertia = partial(_checks.inertia, stacklevel=4)  # a field's converter: it warns where the class is called


class Rotating(AbstractRotatingBody):
    """A body whose states are made from an attitude and a motion."""

    @property
    def own_momentum(self) -> Vector3 | None:
        """h_r in Π = JΩ + h_r, (3,)."""
        return None

    @staticmethod
    def configuration(q: Quaternion) -> Array:
        """The attitude in the form that states have it: the quaternion itself, if the phase space is T*SO(3)."""
        return q

    @explained
    def state(
        self,
        attitude: _checks.Attitude = (1.0, 0.0, 0.0, 0.0),
        *,
        angular_velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
    ) -> State:
        """The state of an attitude and one of three ways to give the motion.

        Args:
            attitude: unit quaternion (w, x, y, z), the scalar part first, or rotation matrix (3, 3), or a
                `scipy.spatial.transform.Rotation`, body to space. The identity is (1, 0, 0, 0); (0, 0, 0, 1), the
                identity in the order of scipy's arrays, is a half rotation about z. A quaternion within 1e-4 of unit
                length is normalized, beyond 1e-6 with a RuntimeWarning. Other orders and directions, Euler angles,
                modified Rodrigues parameters: `li.attitude`.
            angular_velocity: body angular velocity Ω, radians per unit time, shape (3,).
            body_momentum: Π, in the body, shape (3,).
            spatial_momentum: π = ΛΠ, shape (3,).

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or an attitude that is not a rotation.
        """
        turn = _checked_attitude(attitude)
        name, given = _checks.one_of(
            angular_velocity=angular_velocity, body_momentum=body_momentum, spatial_momentum=spatial_momentum
        )
        value = _checks.real_array(name, given, (3,))
        if isinstance(attitude, list | tuple):  # Python numbers, such as those of the default, have no dtype
            turn = turn.astype(value.dtype)
        q, p = _attitude_and_momentum(self.inertia, self.own_momentum, turn, value, name)
        return State(self.configuration(q), _checks.real_array("the spatial momentum", p))

    def momentum(self, state: State) -> MomentumMap:
        """The momentum map of rotations in space (2.13): π itself, that of a rotor included, shape (3,)."""
        return state.p

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or the system is a batch of systems."""
        _checks.of_one_system("inertia", self.inertia)
        q = _checks.real_array("state.q", state.q, (4,))
        if concrete(q):
            _checks.nearly_unit("state.q", np.asarray(q, float), _checks.UNIT_TOLERANCE)
        _checks.real_array("state.p", state.p, (3,))


class Body(Rotating):
    """A body without rotors, so that Π = JΩ; free, unless a subclass has another energy."""

    def energy(self, state: State) -> Scalar:
        """½ Π·J⁻¹Π (2.11)."""
        return self.kinetic_energy(state)

    def kinetic_energy(self, state: State) -> Scalar:
        """½ Π·J⁻¹Π."""
        return vectors.dot(self.body_momentum(state), self.angular_velocity(state)) / 2

    def periods(self, state: State) -> Periods:
        """The two mean periods of a tumbling body, as light curves show them, and its mode, in closed form.

        For a body with torques they are those of the torque-free motion from this state.

        Args:
            state: a state of this body.

        Returns:
            A `Periods`, in the unit of time of the state (that of 1/Ω):
            `precession`, the mean time in which the long axis (that of the least moment) goes once around the angular
            momentum; `rotation`, the period of Ω and Π in the axes of the body, that of one rotation about the long
            axis in the long-axis mode, of one oscillation about it in the short-axis mode; and `long_axis`, True in the
            former. The periods are differentiable in the inertia and the state, except on the separatrix between the
            modes, where the rotation period is infinite.
        """
        return _free_body.periods(self.inertia, self.body_momentum(state))

    def state_from_periods(
        self,
        attitude: _checks.Attitude = (1.0, 0.0, 0.0, 0.0),
        *,
        precession: ArrayLike,
        rotation: ArrayLike,
        long_axis: bool,
        **options: Any,
    ) -> State:
        """The state of a tumbling body with given mean periods, as light curves show them: the inverse of `periods`.

        Of all phases of the motion it returns that in which the body momentum lies in the plane of the long and the
        short axis, with positive components along both: in short-axis modes the long axis is then closest to the
        angular momentum, in long-axis modes farthest from it.

        Args:
            attitude: as in `state`.
            precession: P_φ > 0, the mean period of the long axis about the angular momentum.
            rotation: P_ψ > 0, that of the body about its long axis (long-axis mode), or of its oscillation about it.
            long_axis: the mode: True for the long-axis mode, False for the short-axis mode.
            options: further arguments of `state`, such as t.

        Returns:
            The state. It has first derivatives with respect to the inertia and both periods.

        Raises:
            ValueError: no motion of this body in this mode has this ratio of the periods. A sphere has no such motion.
        """
        if self.inertia.ndim == 2:
            moments, axes = _free_body.principal_axes(self.inertia)
        else:
            ascending = jnp.argsort(self.inertia)
            moments = self.inertia[ascending]
            axes = jnp.eye(3, dtype=moments.dtype)[:, ascending]
        period = _checks.real_array("precession", precession, ()).astype(moments.dtype)
        ratio = _checks.real_array("rotation", rotation, ()).astype(moments.dtype) / period
        _check_ratio(moments, ratio, period, long_axis)
        unit = _free_body.momentum_of_ratio(moments, ratio, long_axis)
        size = _free_body.periods(moments, unit).precession / period
        return self.state(attitude, body_momentum=axes @ (size * unit), **options)


class TimedBody(Body):
    """A body whose state has a time, and may track work."""

    @explained
    def state(
        self,
        attitude: _checks.Attitude = (1.0, 0.0, 0.0, 0.0),
        *,
        angular_velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
        t: ArrayLike = 0.0,
        work: ArrayLike | None = None,
    ) -> State:
        """The state of an attitude, one of three ways to give the motion, and a time.

        Args:
            attitude, angular_velocity, body_momentum, spatial_momentum: as in `rigid_body(...).state`.
            t: the time of the state, a scalar; by default 0.
            work: 0.0 to track the work done on the body from here on; None not to track it.

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or an attitude that is not a rotation.
        """
        start = super().state(
            attitude, angular_velocity=angular_velocity, body_momentum=body_momentum, spatial_momentum=spatial_momentum
        )
        return timed(start, t, work)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        super().check(state)
        if state.t is not None:
            check_timed(state)


def _check_ratio(moments: Array, ratio: Array, precession: Array, long_axis: bool) -> None:
    """ValueError unless concrete periods are those of a motion in the mode."""
    if not isinstance(long_axis, bool | np.bool_):
        raise ValueError(f"long_axis must be True (long-axis mode) or False (short-axis mode), got {long_axis!r}")
    if not concrete(moments, ratio, precession):
        return
    (A, B, C), mode = np.asarray(moments, float), "long-axis" if long_axis else "short-axis"
    if A == C or (long_axis and A == B) or (not long_axis and B == C):
        raise ValueError(f"a body with the moments {A:.6g}, {B:.6g}, {C:.6g} has no {mode} mode")
    near = jnp.asarray(1 - 1e-9 if long_axis else 1e-9, moments.dtype)
    least = float(_least_ratio(moments, near, bool(long_axis)))
    if not (float(precession) > 0 and float(ratio) > least):
        raise ValueError(
            f"rotation/precession must be above {least:.6g}, that of a small wobble, in the {mode} mode of a body with "
            f"the moments {A:.6g}, {B:.6g}, {C:.6g}, got {float(ratio):.6g} and precession = {float(precession):.6g}"
        )


@partial(compiled, static_argnums=2, once=True)
def _least_ratio(moments: Array, s: Array, long_axis: bool) -> Array:
    return _free_body.period_ratio(moments, s, long_axis)


@partial(compiled, static_argnums=4, once=True)
def _attitude_and_momentum(
    inertia: Array, rotor: Array | None, attitude: Array, motion: Array, name: str
) -> tuple[Array, Array]:
    """The quaternion of an attitude, and π of the motion that the argument `name` of `state` gives.

    It is not a function of the system, or JAX would keep a program for each new function of a user in it.
    """
    q = so3.from_matrix(attitude) if attitude.ndim == 2 else so3.normalize(attitude)
    if name == "angular_velocity":
        motion = jnp.stack(vectors.symmetric(inertia) @ motion)
        motion = motion if rotor is None else rotor + motion
    p = motion if name == "spatial_momentum" else so3.Ad(q, motion)
    dtype = jnp.result_type(q, p)
    return q.astype(dtype), p.astype(dtype)


def _checked_attitude(attitude: Any) -> Quaternion:
    """A quaternion or a rotation matrix."""
    attitude = _checks.quaternions(attitude)
    if np.shape(attitude) == (3, 3):
        return _checks.rotation_matrix("attitude", attitude)
    if np.shape(attitude) != (4,):
        raise ValueError(
            "attitude must be a quaternion (w, x, y, z), shape (4,), or a rotation matrix (3, 3) or one scipy "
            f"Rotation, got shape {np.shape(attitude)}; Euler angles: li.attitude.from_euler, modified Rodrigues "
            "parameters: li.attitude.from_mrp; use jax.vmap for batches"
        )
    return _checks.unit_quaternion("attitude", attitude)
