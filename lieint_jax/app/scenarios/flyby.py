"""A tumbling body passes a planet: periods, mode, spin rate and pole before and after, over all phases.

The clock is the time since the perigee, in h; lengths are in km. The members share the orbit; each has its own moments,
periods and pole, drawn from the published errors, and two uniform phases (see `_flyby_motion`): the leaves of the step
have the member axis.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from lieint_jax import _free_body, orbits
from lieint_jax.app.scenarios import _flyby_motion as motion
from lieint_jax.app.scenarios import _flyby_study
from lieint_jax.app.scenarios._keys import HOUR, PositiveFloat, PositiveInt, Published, Source, Table, Text
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.groups import so3
from lieint_jax.types import State, Step

_OBLIQUITY = np.deg2rad(23.4392911)  # of the ecliptic at J2000, IAU 1976

_Period = Literal["precession_period_h", "rotation_period_h", "lightcurve_period_h"]
Mode = Literal["short_axis", "long_axis"]
Frame = Literal["ecliptic", "equator"]


class Measured(Table):
    """A published value with its error, or with errors to both sides, of `sigmas` standard deviations."""

    value: float
    """In the unit that the key names."""
    error: Annotated[float, Field(ge=0)] | None = None
    """To both sides."""
    below: Annotated[float, Field(ge=0)] | None = None
    """To the lower side."""
    above: Annotated[float, Field(ge=0)] | None = None
    """To the upper side."""
    source: Source

    def _check_error(self) -> None:
        if (self.below is None) != (self.above is None) or (self.error is not None and self.below is not None):
            raise ValueError("give error, or both below and above, or none of them")

    def sides(self) -> tuple[float, float]:
        """The errors below and above."""
        if self.below is not None and self.above is not None:
            return self.below, self.above
        error = self.error or 0.0
        return error, error

    def __str__(self) -> str:
        below, above = self.sides()
        return f"{self.value:g}" + (f" ± {above:g}" if below == above else f" −{below:g}/+{above:g}") * (above > 0)


class Orbit(Table):
    """A hyperbola about the planet."""

    gm_km3_s2: PositiveFloat
    """The gravitational parameter of the planet, in km³/s²."""
    perigee_km: PositiveFloat
    """The least distance from the planet's center, in km."""
    eccentricity: Annotated[float, Field(gt=1)]
    """Above 1."""
    inclination_deg: float
    """In degrees."""
    node_deg: float
    """The longitude of the ascending node, in degrees."""
    argument_of_perigee_deg: float
    """In degrees."""
    perigee_utc: str
    """The date of the perigee, as 2029-04-13T21:45:04Z."""
    frame: Frame = "ecliptic"
    """The frame of the elements, J2000; attitudes and poles are ecliptic."""

    @field_validator("perigee_utc")
    @classmethod
    def _check_date(cls, value: str) -> str:
        if datetime.fromisoformat(value).utcoffset() != timedelta(0):
            raise ValueError("must be a date in UTC, such as 2029-04-13T21:45:04Z")
        return value

    def _check_perigee(self) -> None:
        if abs(self.gm_km3_s2 / orbits.EARTH_GM - 1) < 0.01 and self.perigee_km <= orbits.EARTH_RADIUS:
            raise ValueError(
                f"perigee_km = {self.perigee_km:g} lies in the Earth, whose radius is {orbits.EARTH_RADIUS:.0f} km: "
                "give the distance from its center"
            )

    def elements(self) -> tuple[float, ...]:
        """The arguments of `orbits.kepler`, in km, h and rad, in ecliptic axes."""
        angles = np.deg2rad([self.node_deg, self.inclination_deg, self.argument_of_perigee_deg])
        if self.frame == "equator":
            tilt = so3.exp(jnp.asarray([-_OBLIQUITY, 0.0, 0.0]))
            angles = np.asarray(so3.to_euler_313(so3.multiply(tilt, so3.from_euler_313(jnp.asarray(angles)))))
        node, inclination, argument = map(float, angles)
        a = self.perigee_km / (1 - self.eccentricity)
        return self.gm_km3_s2 * HOUR**2, a, self.eccentricity, inclination, node, argument, 0.0

    def date(self, hours: float) -> datetime:
        return datetime.fromisoformat(self.perigee_utc) + timedelta(hours=hours)


class SpinValues(Table):
    """Values of the tumbling; a variant may replace any of them."""

    least_moment: Measured | None = None
    """The least principal moment, about x, over the greatest, about z."""
    middle_moment: Measured | None = None
    """The middle one, about y, over the greatest."""
    precession_period_h: Measured | None = None
    """The period of the long axis about the angular momentum, in h."""
    rotation_period_h: Measured | None = None
    """The period of the angular momentum in the body, in h."""
    momentum_longitude_deg: Measured | None = None
    """The ecliptic longitude of the angular momentum, in degrees; its error along the parallel, in degrees of arc."""
    momentum_latitude_deg: Measured | None = None
    """The ecliptic latitude of the angular momentum, in degrees."""

    def measured(self) -> dict[str, Any]:
        """The values by their keys."""
        return {name: x for name, x in self if name in SpinValues.model_fields}


class Tumbling(SpinValues):
    """The tumbling before the passage."""

    mode: Mode
    """Whether the angular momentum circles the axis of greatest or of least moment in the body."""
    least_moment: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    middle_moment: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    precession_period_h: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    rotation_period_h: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    momentum_longitude_deg: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    momentum_latitude_deg: Measured  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    precession_phase_deg: float = 0.0
    """φ of the nominal member at the perigee, in degrees."""
    rotation_phase_deg: float = 0.0
    """ψ of the nominal member at the perigee, in degrees."""

    def _check_mode(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise ValueError unless the body has a mode with these periods."""
        least, middle = self.least_moment.value, self.middle_moment.value
        if not 0 < least < middle < 1:
            raise ValueError("must be 0 < least_moment < middle_moment < 1, over the greatest")
        ratio = self.rotation_period_h.value / self.precession_period_h.value
        if not _free_body.mode_exists(jnp.asarray([least, middle, 1.0]), jnp.asarray(ratio), self.long_axis):
            raise ValueError(f"no {self.mode} mode of these moments has periods of the ratio {ratio:g}")

    def with_changes(self, changes: SpinValues) -> Tumbling:
        """The tumbling with the given changes."""
        return self.model_copy(update={name: x for name, x in changes.measured().items() if x is not None})

    @property
    def long_axis(self) -> bool:
        return self.mode == "long_axis"

    @property
    def same_passage_deg(self) -> int:
        """The change of φ, in degrees, that gives the same passage if ψ changes by 180°.

        The body is then rotated by 180° about the axis that Π circles: its short axis, which reverses the long one, or
        the long axis itself.
        """
        return 0 if self.long_axis else 180


class Variant(SpinValues):
    """A variant of the scenario with other assumptions."""

    label: Text
    """Shown in the report."""
    frame: Frame | None = None
    """The frame of the orbit's elements."""


class Phases(Table):
    """The grid of the map: φ over 360°, ψ over 180°."""

    precession_phases: Annotated[int, Field(gt=0, multiple_of=2)]
    """The number of values of φ, even."""
    rotation_phases: PositiveInt
    """The number of values of ψ."""


class Known(Published):
    """A published number, in the unit of the quantity's name."""

    quantity: Literal["perigee_distance_km", "perigee_time_utc_h", _Period, "energy_ratio"]
    """Which quantity it is."""


class Expected(Table):
    """A published expectation of the change."""

    claim: Text
    """In short."""
    quantity: Annotated[
        Literal["rate", "pole_angle", "longitude", "latitude", "mode"],
        BeforeValidator(lambda x: "pole_angle" if x == "turn" else x),
    ]
    """The measured quantity with which the report compares it."""
    source: Source


class Flyby(Kind):
    """The keys of a scenario of this kind."""

    time_unit: Literal["h"] = "h"  # pyright: ignore[reportIncompatibleVariableOverride]
    """Hours since the perigee."""
    dt: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """The mean step, which follows from hours and steps; files of results have it."""
    order: Literal[2, 4, 6, 8] = 8
    """The order of the symplectic splitting, above 2 by composition."""
    hours: PositiveFloat
    """The length of the run before and after the perigee, in h."""
    arcs_hours: Annotated[list[PositiveFloat], Field(min_length=1)]
    """The same for other runs: the report shows how the results converge with it."""
    sigmas: PositiveFloat = 1.0
    """The number of standard deviations of the errors of the spin."""
    orbit: Orbit
    spin: Tumbling
    map: Phases
    variant: list[Variant] = []
    published: list[Known] = []
    expected: list[Expected] = []
    notes: list[Text] = []
    """Paragraphs at the end of the report: assumptions, checks, and effects that the model omits."""

    own_step = True  # every member has its own body
    no_spread: ClassVar[str] = "the members are spread by the errors in the keys of spin; they share the orbit"

    def _check_variants(self) -> None:
        for variant in self.variant:
            try:
                self.spin.with_changes(variant).check()
            except ValueError as error:
                raise ValueError(f"variant {variant.label!r}: {error}") from None

    def _check_and_set_dt(self) -> None:
        dt = 2 * self.hours / self.steps
        if self.dt is not None and self.dt != dt:
            raise ValueError("dt is given by hours and steps: leave it out")
        self.dt = dt  # pyright: ignore[reportIncompatibleVariableOverride]

    def _check_epoch(self) -> None:
        if self.epoch is not None:
            raise ValueError("epoch: t = 0 is the perigee, whose date is orbit.perigee_utc: leave epoch out")

    def date_of_zero(self) -> datetime:
        """That of the perigee."""
        return self.orbit.date(0)

    def times(self, hours: float | None = None, steps: int | None = None) -> np.ndarray:
        """The boundaries of the steps, graded along the orbit."""
        hours = self.hours if hours is None else hours
        return orbits.graded_times(motion.GivenOrbit(self.orbit.elements()), -hours, hours, steps or self.steps)

    def every_second_phase(self, grid: Any) -> Any:
        """Every second value of both phases of a tree of values at all of them."""
        n, m = self.map.precession_phases, self.map.rotation_phases
        return jax.tree.map(lambda x: x.reshape(n, m)[::2, ::2].ravel(), grid)

    def clock(self) -> dict[str, Any]:
        return {"times": self.times()}

    def describe_steps(self) -> str:
        sizes = np.diff(self.times())
        return f"{self.steps} graded steps of {sizes.min():.2g} to {sizes.max():.2g} h, ± {self.hours:g} h"

    def assumption(self) -> str:
        spin = self.spin
        return (
            f"members: both phases uniform; moments {spin.least_moment}, {spin.middle_moment}, 1; periods "
            f"{spin.precession_period_h} h, {spin.rotation_period_h} h;\n  pole ({spin.momentum_longitude_deg}°, "
            f"{spin.momentum_latitude_deg}°), errors along parallel and meridian; all errors {self.sigmas:g} sigma"
        )

    def deviates(self, indices: np.ndarray) -> motion.Spin:
        """The spins of all members."""
        return motion.members(self)[0]

    def member(self, noise: motion.Spin) -> tuple[Step, State]:
        """The step and the state at the start of a member."""
        orbit, t = motion.GivenOrbit(self.orbit.elements()), jnp.asarray(-self.hours)
        return motion.step_and_state(noise, orbit, t, self.order, self.spin.long_axis)

    report = _flyby_study.report  # pyright: ignore[reportAssignmentType]
    draw_map, draw_after = _flyby_study.draw_map, _flyby_study.draw_after
    draw_sensitivity = _flyby_study.draw_sensitivity
