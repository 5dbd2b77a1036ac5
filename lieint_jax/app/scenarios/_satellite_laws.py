"""The torques on a satellite in a low orbit: the keys of its surroundings and equipment, and their laws."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax import orbits, torques
from lieint_jax.app.scenarios._keys import NonNegative, PositiveFloat, PositiveTriple, Table, Triple, UnitVector
from lieint_jax.app.scenarios._spread import DIRECTION
from lieint_jax.types import Law

_KM = 1e3  # m
_FIELD_RADIUS = 6371.2e3  # m, of the coefficients of IGRF

Window = Annotated[list[float], Field(min_length=2, max_length=2)]


class Orbit(Table):
    """A Kepler orbit about the Earth."""

    perigee_km: PositiveFloat
    """The height above the equatorial radius."""
    eccentricity: Annotated[float, Field(ge=0, lt=1)] = 0.0
    inclination_deg: float
    """In degrees, as the two angles below."""
    node_deg: float = 0.0
    """The right ascension of the ascending node."""
    perigee_deg: float = 0.0
    """The argument of the perigee, where the satellite is at t = 0."""

    def motion(self) -> orbits.Kepler:
        """The orbit in m and s."""
        perigee = (orbits.EARTH_RADIUS + self.perigee_km) * _KM
        inclination, node, argument = np.deg2rad([self.inclination_deg, self.node_deg, self.perigee_deg])
        size = perigee / (1 - self.eccentricity)
        mu = orbits.EARTH_GM * _KM**3
        return orbits.kepler(mu, size, self.eccentricity, inclination, node=node, periapsis=argument)


class Drag(Table):
    """The air on the six faces of a box."""

    box_m: PositiveTriple
    """The lengths of its edges along the body axes."""
    center_m: Triple = [0.0, 0.0, 0.0]
    """The middle of the box, from the center of mass, in body axes."""
    coefficient: NonNegative = 2.2
    density_kg_m3: PositiveFloat
    """The density of the air at height_km; it varies by a factor of ten with the activity of the Sun."""
    height_km: NonNegative
    """Above the equatorial radius."""
    scale_height_km: PositiveFloat
    """The height over which the density falls to 1/e."""


class Rods(Table):
    """Rods of soft magnetic material, one along each axis."""

    axes: Annotated[list[UnitVector], Field(min_length=1), DIRECTION]
    """Unit vectors in the body."""
    saturation: PositiveFloat
    """The greatest moment of a rod, in A m²."""
    slope: PositiveFloat
    """The field over which the moment rises, in tesla: M = saturation × tanh(w/slope)."""
    coercivity: NonNegative
    """The half-width of the hysteresis loop, in tesla."""


class Wheels(Table):
    """Reaction wheels on a pyramid about the z axis, at rest in the body at t = 0."""

    number: Annotated[int, Field(ge=3, le=100)] = 4
    tilt_deg: Annotated[float, Field(gt=0, lt=90)] = 35.264389682754654
    """From the xy-plane to the axes."""
    inertia_kg_m2: PositiveFloat
    """The moment of inertia of each wheel about its axis."""
    max_torque: PositiveFloat
    """The largest torque of each motor, in N m."""
    max_momentum: PositiveFloat
    """The largest momentum of each wheel, in N m s."""
    period: PositiveFloat | None = None
    """From one sample of the motors' digital controller to the next, in time_unit; dt divides it. Default: no delay."""

    def axes(self) -> Array:
        return torques.wheel_pyramid(np.deg2rad(self.tilt_deg), self.number)


class Control(Table):
    """A law of control that acts in a window of time."""

    window: Window
    """The first and last time at which it acts, in time_unit."""

    def _check_window(self) -> None:
        if not self.window[0] < self.window[1]:
            raise ValueError(f"window must be [from, to] with from < to, got {self.window}")


class Detumbling(Control):
    """Torquers with the moment gain × angular velocity × field, the law B-dot."""

    gain: PositiveFloat
    """In N m s/T²."""


class Pointing(Control):
    """Wheels that point z to the nadir and x forward, like a damped spring about each axis."""

    frequency: PositiveFloat
    """The frequency of the spring, in rad/s: that of small errors without damping."""
    damping_ratio: PositiveFloat = 1.0
    """1: critical."""


class Unloading(Control):
    """Torquers that remove the momentum of the wheels."""

    gain: PositiveFloat
    """In 1/s: the rate at which the momentum across the field falls."""


class Surroundings(NamedTuple):
    """Functions of time along the orbit, the same for all members."""

    orbit: Any  # position and velocity, m and m/s
    mu: float  # the gravitational parameter, m³/s²
    field: Any  # the Earth's magnetic field in space, T
    frame: orbits.SharedFrame  # the local vertical, local horizontal frame: z down, x forward
    air: Any  # density and relative velocity of the air, or None


def surroundings(motion: Any, date: str, drag: Drag | None) -> Surroundings:
    """The surroundings along an orbit, a function of time with `mu`, from a date on."""
    field = orbits.earth_field(motion, date, radius=_FIELD_RADIUS)
    air = None
    if drag is not None:
        height, scale = drag.height_km * _KM, drag.scale_height_km * _KM
        air = orbits.atmosphere(motion, drag.density_kg_m3, scale, height, radius=orbits.EARTH_RADIUS * _KM)
    orbit = orbits.shared(motion)
    frame: Any = orbits.shared(orbits.lvlh(orbit))
    return Surroundings(orbit, float(motion.mu), orbits.shared(field), frame, air and orbits.shared(air))


def laws(scenario: Any, around: Surroundings, inertia: Array, dipole: Array) -> list[Law]:
    """All laws of a scenario, for a body with a locked inertia (3, 3) and a residual dipole (3,)."""
    found: list[Law] = [
        torques.gravity_gradient(around.orbit, inertia, around.mu),
        torques.dipole(dipole, around.field),
    ]
    if (drag := scenario.drag) is not None:
        plates = torques.box_plates(drag.box_m, drag.center_m)
        found.append(torques.aerodynamic(around.air, *plates, drag=drag.coefficient))
    if (rods := scenario.rods) is not None:
        material = rods.saturation, rods.slope, rods.coercivity
        found += [
            torques.hysteresis(axis, *material, field=around.field, key=f"rod_{k + 1}")
            for k, axis in enumerate(rods.axes)
        ]
    if (detumbling := scenario.detumbling) is not None:
        bdot = torques.bdot(detumbling.gain, around.field, scenario.max_dipole)
        found.append(torques.windowed(bdot, *detumbling.window))
    if (unloading := scenario.unloading) is not None:
        dumping = torques.unloading(scenario.wheels.axes(), unloading.gain, around.field, scenario.max_dipole)
        found.append(torques.windowed(dumping, *unloading.window))
    if (wheels := scenario.wheels) is not None:
        found.append(_wheels_with_motors(wheels, scenario.pointing, around, inertia))
    return found


def _wheels_with_motors(wheels: Wheels, pointing: Pointing | None, around: Surroundings, inertia: Array) -> Law:
    """The wheels with their motors."""
    axes, motor = wheels.axes(), None
    if pointing is not None:
        moments, rate = jnp.diagonal(inertia), pointing.frequency
        control = torques.pointing(
            around.frame, 2 * rate**2 * moments, 2 * pointing.damping_ratio * rate * moments, inertia
        )
        motor = torques.wheel_motor(axes, control, gyroscopic=True, window=pointing.window)
    limits = {"max_torque": wheels.max_torque, "max_momentum": wheels.max_momentum, "period": wheels.period}
    return torques.wheels(axes, wheels.inertia_kg_m2, motor, **limits)
