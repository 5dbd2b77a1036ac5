"""What carries out a control law: wheels with motors, magnetic torquers; and torquers that unload wheels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, named, not_negative, positive
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import cross, dot
from lieint_jax.core import Converted, Law, Rotation, argument, parts, pytree, static
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import VectorOfTime, cut, example_of_time, value_at, vector_of_time
from lieint_jax.torques._body_axes import middle_axes
from lieint_jax.torques._damping import Viscous
from lieint_jax.torques._wheels import Motor, wheel_axes
from lieint_jax.torques._window import mean_in_window, window

__all__ = ["WheelMotor", "allocation", "torquers", "unloading", "wheel_motor", "wheel_pyramid"]


def wheel_pyramid(tilt: ArrayLike = 0.6154797086703874, wheels: int = 4) -> Array:
    """The axes of reaction wheels on a pyramid about the body's z axis, unit vectors (m, 3).

    Args:
        tilt: the angle from the xy-plane to the axes, in radians; by default 35.26°, where four wheels have the same
            authority about all body axes.
        wheels: m ≥ 3.

    Raises:
        ValueError: fewer than 3 wheels, a tilt that is no finite number.
    """
    m, beta = _checks.count("wheels", wheels, 3), _checks.real_array("tilt", tilt, ())
    angle = 2 * np.pi * np.arange(m) / m
    c, s = jnp.cos(beta), jnp.sin(beta)
    x, y = (f(angle).astype(c.dtype) for f in (np.cos, np.sin))
    return jnp.stack([c * x, c * y, jnp.broadcast_to(s, (m,))], axis=1)


def allocation(axes: ArrayLike) -> Array:
    """The matrix (m, 3) from a torque to those of the wheels, Σ g_j u_j = T with the least Σu_j²: the pseudo-inverse.

    Args:
        axes: g_j in the body, unit vectors, (m, 3).

    Raises:
        ValueError: axes that are not of unit length, or that do not span all directions.
    """
    g = wheel_axes(axes)
    if concrete(g) and np.linalg.matrix_rank(np.asarray(g)) < 3:
        raise ValueError(f"axes must span all directions, got {np.asarray(g)}: there is a torque that they cannot give")
    return g @ jnp.linalg.inv(g.T @ g)


def control_laws(control: Any) -> tuple[Law, ...]:
    """The laws of a control law, or of several; ValueError if one has an internal state."""
    laws = control if isinstance(control, tuple) else parts(control)
    for law in laws:
        if (key := law.key or law.reads) is not None:
            raise ValueError(
                f'a control law must not have an internal state, and {type(law).__name__} has State.extra["{key}"]: '
                "add it to the other laws of the body"
            )
    return laws


_limit = named(positive, "max_dipole", (), (3,), optional=True)


def control_torque(laws: tuple[Law, ...], t: Array, q: Array, Omega: Array) -> Array:
    """The torque of control laws in the body."""
    total = jnp.zeros_like(Omega)
    for law in laws:
        if law.frame == "space":
            total = total + so3.Ad_star(q, law(t, q, so3.Ad(q, Omega)))
        else:
            total = total + law(t, q, Omega)
    return total


def _window(times: Sequence[ArrayLike] | None) -> tuple[Array, Array] | None:
    if times is None:
        return None
    try:
        start, stop = times
    except (TypeError, ValueError) as error:
        raise ValueError(f"window must be two times, start and stop, got {times!r}") from error
    return window("the window of a motor", start, stop)


@pytree
class WheelMotor(Motor):
    """The motors that let wheels carry out a control law: `wheels(axes, inertias, wheel_motor(axes, control))`.

    Args:
        axes: g_j in the body, unit vectors that span all directions, (m, 3).
        control: the torque that the body shall get: a law without an internal state such as `pointing`, a sum of such
            laws, or a function (t, q, Ω) ↦ (3,) in the body.
        gyroscopic: whether the motors also cancel Ω × Σg_jh_j, which the wheels' momentum does to the body.
        window: the times from and to which the motors act; outside the wheels rotate freely. By default always. In a
            step that the window begins or ends in they give their torque times the part of the step in the window.

    Raises:
        ValueError: axes that are not of unit length or do not span all directions, a law with an internal state, a
            window that stops before it starts.
    """

    axes: Converted[Array] = argument(converter=wheel_axes)
    control: Converted[tuple[Law, ...]] = argument(converter=control_laws)
    gyroscopic: Converted[bool] = static(converter=bool, default=False)
    window: Converted[tuple[Array, Array] | None] = argument(converter=_window, default=None)
    allocation: Array = dataclasses.field(init=False)  # from a torque to those of the wheels, (m, 3)

    def check_fields(self) -> dict[str, Array]:
        """The allocation; ValueError if the axes do not span all directions."""
        return {"allocation": allocation(self.axes)}

    def __call__(self, t: Array, q: Array, Omega: Array, h: Array) -> Array:
        """The torques dh_j/dt on the wheels at one instant, (m,)."""
        return self.mean(Rotation.at_instant(t, q, Omega, so3.Ad(q, Omega)), h)

    def mean(self, rotation: Rotation, h: Array, limit: Array | None = None) -> Array:
        """The mean torques dh_j/dt of a step, (m,), from the control law at its middle."""
        momentum = jnp.stack(cross(rotation.Omega, h @ self.axes)) if self.gyroscopic else 0
        control = control_torque(self.control, rotation.t, rotation.q_mid, rotation.Omega)
        torques = -(self.allocation @ (control + momentum))
        torques = torques if limit is None else cut(torques, limit)
        return torques if self.window is None else mean_in_window(rotation, *self.window, torques)


@pytree
class Torquers(Law):
    """Magnetic torquers that carry out a control law as far as they can: the part of its torque across the field.

    With the moment m = B × T/|B|², cut at the limit, the torque m × B is T less its part along B. In the changing field
    of an orbit a slow law points in all axes.

    Args:
        control: as in `wheel_motor`.
        field: b in space, (3,), or a function of time with such values, such as `orbits.earth_field(orbit, date)`.
        max_dipole: the largest moment of a torquer, > 0, a number or one for each body axis, (3,); None for no limit.

    Raises:
        ValueError: a law with an internal state, a field that is no vector and no function, a limit that is not
            positive.

    Source: Sidi 1997, Spacecraft Dynamics and Control, 7.4.
    """

    control: Converted[tuple[Law, ...]] = argument(converter=control_laws)
    field: Converted[VectorOfTime] = argument(converter=named(vector_of_time, "field"))
    max_dipole: Converted[Array | None] = argument(converter=_limit, default=None)

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law at the middle of the step."""
        B = middle_axes(rotation, value_at(self.field, rotation.t))
        torque = control_torque(self.control, rotation.t, rotation.q_mid, rotation.Omega)
        return _magnetic_torque(torque, B, self.max_dipole), inner


@pytree
class Unloading(Law):
    """m × B with m = k h_r × B/|B|²: torquers that unload wheels. Made by `unloading`."""

    axes: Array
    gain: Array
    field: VectorOfTime
    max_dipole: Array | None
    bias: Array
    reads: str = static(default="wheels")  # pyright: ignore[reportIncompatibleVariableOverride]

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law at the middle of the step, with the mean momenta of the wheels."""
        B = middle_axes(rotation, value_at(self.field, rotation.t))
        return _magnetic_torque(-self.gain * ((inner - self.bias) @ self.axes), B, self.max_dipole), inner


def unloading(
    axes: ArrayLike,
    gain: ArrayLike,
    field: Any,
    max_dipole: ArrayLike | None = None,
    *,
    bias: ArrayLike = 0.0,
    key: str = "wheels",
) -> Unloading:
    """Momentum dumping by torquers: T = −k h_r less its part along the field, h_r = Σ g_j(h_j − bias_j) of the wheels.

    Add this law to wheels whose motors hold the attitude: the motors transfer the torquers' torque to the wheels.

    Args:
        axes: g_j of the wheels in the body, unit vectors, (m, 3).
        gain: k ≥ 0, 1 / time: the momentum falls as e^(−kt) across a field.
        field: b in space, (3,), or a function of time with such values.
        max_dipole: the largest moment of a torquer, > 0, a number or one for each body axis, (3,); None for no limit.
        bias: the momenta that the wheels shall have, a number or (m,).
        key: that of the wheels' law.

    Raises:
        ValueError: axes that are not of unit length, a negative gain, a field that is no vector and no function, a
            limit that is not positive. The system of the sum raises one if there are no wheels in it.

    Source: Camillo & Markley 1980, J. Guid. Control 3.
    """
    g = wheel_axes(axes)
    momenta = _checks.for_each(_checks.real_array, "bias", bias, len(g))
    k, b = not_negative("gain", gain), vector_of_time("field", field)
    return Unloading(g, k, b, _limit(max_dipole), momenta, key)


def _magnetic_torque(torque: Array, B: Array, max_dipole: Array | None) -> Array:
    """m × B with m = B × T/|B|² of a torque T, cut at a limit; 0 where there is no field."""
    square = dot(B, B)
    m = jnp.stack(cross(B, torque)) / jnp.where(square > 0, square, 1)
    return jnp.stack(cross(m if max_dipole is None else cut(m, max_dipole), B))


torquers, wheel_motor = Torquers, WheelMotor


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    axes, control, field = wheel_pyramid(0.6), Viscous(0.3), example_of_time()
    return {
        "wheel_pyramid": partial(wheel_pyramid, tilt=0.6, wheels=4),
        "allocation": partial(allocation, axes=axes),
        "wheel_motor": partial(wheel_motor, axes=axes, control=control, gyroscopic=True, window=(0.72, 0.77)),
        "torquers": partial(torquers, control=control, field=field, max_dipole=0.1),
        "unloading": partial(unloading, axes=axes, gain=0.4, field=field, max_dipole=0.1, bias=0.05, key="wheels"),
    }
