"""A tumbling body passes a planet: periods, mode, spin rate and pole before and after, over all phases.

The clock is the time since the perigee, in h; lengths are in km. The members share the orbit; each has moments, periods
and a pole of its own, drawn from the published errors, and two phases, which are uniform: the leaves of the step that
`build` makes have the member axis. See `_flyby_motion` for the phases.
"""

from __future__ import annotations

import textwrap
from datetime import datetime, timedelta
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure
from pydantic import Field, field_validator, model_validator

from lieint_jax import orbits, plots
from lieint_jax._numerics import three
from lieint_jax.groups import so3
from lieint_jax.scenarios import _flyby_motion as motion
from lieint_jax.scenarios._common import Common, Positive, Table, Text
from lieint_jax.scenarios._flyby_motion import GivenOrbit, Outcome, Passage, Slopes, Spin
from lieint_jax.types import State, Step, Trajectory

STEP_AXIS = 0  # members have bodies of their own, see `lieint_jax.scenarios`

_HOUR = 3600.0
_OBLIQUITY = np.deg2rad(23.4392911)  # of the ecliptic at J2000, IAU 1976
_TRIES = 16  # draws of a member's moments, of which the first that has such periods is taken
_WATCHED = 256  # members whose steps are halved
_SLOPE_ORDER = 4  # of the steps that are differentiated: derivatives are right to 5e-4 of the largest
_QUANTILES = (0.05, 0.5, 0.95)

Above = Annotated[float, Field(gt=0)]
Mode = Literal["short_axis", "long_axis"]
Frame = Literal["ecliptic", "equator"]


class Measured(Table):
    """A published value, with its error, or with errors to either side, of so many `sigmas`."""

    value: float
    """In the unit that the key names."""
    error: Annotated[float, Field(ge=0)] | None = None
    """To both sides."""
    below: Annotated[float, Field(ge=0)] | None = None
    """To the lower side."""
    above: Annotated[float, Field(ge=0)] | None = None
    """To the upper side."""
    source: str
    """A key of the table sources."""

    @model_validator(mode="after")
    def _one_kind_of_error(self) -> Self:
        if (self.below is None) != (self.above is None) or (self.error is not None and self.below is not None):
            raise ValueError("give error, or both below and above, or none of them")
        return self

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

    gm_km3_s2: Above
    """The gravitational parameter of the planet, in km³/s²."""
    perigee_km: Above
    """The least distance from the planet's centre, in km."""
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
    """Of the elements, J2000; attitudes and poles are ecliptic."""

    @field_validator("perigee_utc")
    @classmethod
    def _a_date(cls, value: str) -> str:
        if datetime.fromisoformat(value).utcoffset() != timedelta(0):
            raise ValueError("must be a date in UTC, such as 2029-04-13T21:45:04Z")
        return value

    def elements(self) -> tuple[float, ...]:
        """The arguments of `orbits.kepler`, in km, h and rad, in ecliptic axes."""
        angles = np.deg2rad([self.node_deg, self.inclination_deg, self.argument_of_perigee_deg])
        if self.frame == "equator":
            tilt = so3.exp(jnp.asarray([-_OBLIQUITY, 0.0, 0.0]))
            angles = np.asarray(so3.to_euler_313(so3.multiply(tilt, so3.from_euler_313(jnp.asarray(angles)))))
        node, inclination, argument = map(float, angles)
        a = self.perigee_km / (1 - self.eccentricity)
        return self.gm_km3_s2 * _HOUR**2, a, self.eccentricity, inclination, node, argument, 0.0

    def date(self, hours: float) -> datetime:
        return datetime.fromisoformat(self.perigee_utc) + timedelta(hours=hours)


class Changes(Table):
    """What is known of the tumbling, or of a part of it."""

    least_moment: Measured | None = None
    """The least principal moment, about x, over the greatest, about z."""
    middle_moment: Measured | None = None
    """The middle one, about y, over the greatest."""
    precession_period_h: Measured | None = None
    """Of the long axis about the angular momentum, in h."""
    rotation_period_h: Measured | None = None
    """Of the angular momentum in the body, in h."""
    momentum_longitude_deg: Measured | None = None
    """Of the angular momentum, ecliptic, in degrees; its error along the parallel, in degrees of a great circle."""
    momentum_latitude_deg: Measured | None = None
    """Of the angular momentum, ecliptic, in degrees."""


class Tumbling(Changes):
    """The tumbling before the passage."""

    mode: Mode
    """Whether the angular momentum goes round the axis of greatest or of least moment."""
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

    @model_validator(mode="after")
    def _a_mode_with_these_periods(self) -> Self:
        least, middle = self.least_moment.value, self.middle_moment.value
        if not 0 < least < middle < 1:
            raise ValueError("must be 0 < least_moment < middle_moment < 1, over the greatest")
        ratio = self.rotation_period_h.value / self.precession_period_h.value
        if not motion.possible(jnp.asarray([least, middle, 1.0]), jnp.asarray(ratio), self.long_axis):
            raise ValueError(f"no {self.mode} mode of these moments has periods of the ratio {ratio:g}")
        return self

    @property
    def long_axis(self) -> bool:
        return self.mode == "long_axis"


class Variant(Changes):
    """Other assumptions."""

    label: Text
    """Shown in the report."""
    frame: Frame | None = None
    """Of the orbit's elements."""


class Phases(Table):
    """The grid of the map: φ over 360°, ψ over 180°."""

    precession_phases: Positive
    """The number of values of φ."""
    rotation_phases: Positive
    """The number of values of ψ."""


class Known(Table):
    """A published number."""

    quantity: Literal[
        "perigee_distance_km",
        "perigee_time_utc_h",
        "precession_period_h",
        "rotation_period_h",
        "lightcurve_period_h",
        "energy_ratio",
    ]
    """What it is of."""
    value: float
    """In the unit that the name has."""
    error: Annotated[float, Field(gt=0)] | None = None
    """Of so many `sigmas`."""
    source: str
    """A key of the table sources."""


class Expected(Table):
    """A published expectation of the change."""

    claim: Text
    """In short."""
    quantity: Literal["rate", "turn", "longitude", "latitude", "mode"]
    """What the report holds against it."""
    source: str
    """A key of the table sources."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["flyby"]  # pyright: ignore[reportIncompatibleVariableOverride]
    time_unit: Literal["h"] = "h"  # pyright: ignore[reportIncompatibleVariableOverride]
    """Hours since the perigee."""
    dt: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """The mean step, given by hours and steps: results hold it."""
    order: Literal[2, 4, 6, 8] = 8
    """Of the symplectic splitting, above 2 by composition."""
    hours: Above
    """The run is from so long before the perigee to so long after it."""
    arcs_hours: Annotated[list[Above], Field(min_length=1)]
    """The same for other runs, of which the report says how the results converge."""
    sigmas: Above = 1.0
    """The errors of the spin are of so many standard deviations."""
    orbit: Orbit
    spin: Tumbling
    map: Phases
    variant: list[Variant] = []
    published: list[Known] = []
    expected: list[Expected] = []

    @model_validator(mode="after")
    def _mean_step(self) -> Self:
        dt = 2 * self.hours / self.steps
        if self.dt is not None and self.dt != dt:
            raise ValueError("dt is given by hours and steps: leave it out")
        self.dt = dt  # pyright: ignore[reportIncompatibleVariableOverride]
        return self

    def times(self, hours: float | None = None, steps: int | None = None) -> np.ndarray:
        """The steps' boundaries, graded along the orbit."""
        hours = self.hours if hours is None else hours
        return orbits.graded_times(GivenOrbit(self.orbit.elements()), -hours, hours, steps or self.steps)

    def clock(self) -> dict[str, Any]:
        return {"times": self.times()}

    def pace(self) -> str:
        sizes = np.diff(self.times())
        return f"{self.steps} graded steps of {sizes.min():.2g} to {sizes.max():.2g} h, ± {self.hours:g} h"

    def assumption(self) -> str:
        spin = self.spin
        return (
            f"members: both phases uniform; moments {spin.least_moment}, {spin.middle_moment}, 1; periods "
            f"{spin.precession_period_h} h, {spin.rotation_period_h} h;\n  pole ({spin.momentum_longitude_deg}°, "
            f"{spin.momentum_latitude_deg}°), errors along parallel and meridian; all errors {self.sigmas:g} sigma"
        )


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step, whose leaves have the member axis, and the batch of states at the start, which share their time."""
    orbit, t = GivenOrbit(scenario.orbit.elements()), jnp.asarray(-scenario.hours)
    made = partial(motion.member, orbit=orbit, t=t, order=scenario.order, long_axis=scenario.spin.long_axis)
    step, states = jax.jit(jax.vmap(made))(members(scenario)[0])
    return step, states._replace(t=t)


def members(scenario: Scenario) -> tuple[Spin, np.ndarray]:
    """The members' spins, the nominal one first, and whether the first draw of each had such a mode.

    A member is the same in ensembles of every size.
    """
    spin, seed = scenario.spin, jax.random.key(scenario.seed)
    known = np.array([[x.value, *x.sides()] for x in (getattr(spin, name) for name in Changes.model_fields)])
    known[:, 1:] /= scenario.sigmas
    phases = np.deg2rad([spin.precession_phase_deg, spin.rotation_phase_deg])
    spins, first = _drawn(seed, jnp.arange(scenario.members), known, phases, spin.long_axis)
    return spins, np.asarray(first)


@partial(jax.jit, static_argnums=4)
@partial(jax.vmap, in_axes=(None, 0, None, None, None))
def _drawn(seed: Array, k: Array, known: Array, phases: Array, long_axis: bool) -> tuple[Spin, Array]:
    """The k-th member; `known` has a row for each key of `Changes`: value, standard deviations below and above."""
    key = jax.random.fold_in(seed, k)
    noise = jnp.where(k == 0, 0.0, jax.random.normal(key, (_TRIES, 6)))
    drawn = known[:, 0] + jnp.where(noise < 0, known[:, 1], known[:, 2]) * noise
    least, middle, precession, rotation = drawn.T[:4]
    sound = (least > 0) & (least < middle) & (middle < 1)
    J = jnp.stack([jnp.where(sound, least, 0.5), jnp.where(sound, middle, 0.75), jnp.ones_like(least)], axis=1)
    has = jax.vmap(lambda J, ratio: motion.possible(J, ratio, long_axis))(J, rotation / precession)
    good = sound & has
    one = jnp.argmax(good)
    longitude, latitude = _moved(*jnp.deg2rad(known[4:, 0]), *jnp.deg2rad(known[4:, 2] * noise[0, 4:]))
    turns = jax.random.uniform(jax.random.fold_in(key, 1), (2,)) * 2 * jnp.pi
    phi, psi = jnp.where(k == 0, phases, turns)
    return Spin(least[one], middle[one], precession[one], rotation[one], longitude, latitude, phi, psi), good[0]


def _moved(longitude: Array, latitude: Array, east: Array, north: Array) -> tuple[Array, Array]:
    """The longitude and latitude at the end of a great circle that sets out by (east, north), rad."""
    pole = motion.direction(longitude, latitude)
    to_east = jnp.stack([-jnp.sin(longitude), jnp.cos(longitude), jnp.zeros_like(longitude)])
    to_north = motion.direction(longitude, latitude + jnp.pi / 2)
    away = east * to_east + north * to_north
    x, y, z = so3.Ad(so3.exp(jnp.stack(three.cross(pole, away))), pole)
    return jnp.arctan2(y, x), jnp.arcsin(z)


class Study(NamedTuple):
    """What the report and the pictures show beside the members of the run.

    Attributes:
        before, after: of the members.
        grid: the spins of the map, φ slowest; mapped: their passages.
        slopes: derivatives at every second value of both phases.
        halved: the largest angle between attitudes at the end by the steps of the run and by half as long ones.
        arcs: passages of the first members by the length of the arc in h.
        variants: passages under other assumptions, by their labels.
        failed: the number of these passages with a step that did not converge.
    """

    before: Outcome
    after: Outcome
    grid: Spin
    mapped: Passage
    slopes: Slopes
    halved: float
    arcs: dict[float, Passage]
    variants: dict[str, Passage]
    failed: int


_last: list[tuple[Trajectory, Study]] = []


def study(scenario: Scenario, step: Step, run: Trajectory) -> Study:
    """The study of a run; that of the last run is kept, for its pictures and its report."""
    if not (_last and _last[0][0] is run):
        _last[:] = [(run, _study(scenario, step, run))]
    return _last[0][1]


def _study(scenario: Scenario, step: Any, run: Trajectory) -> Study:
    from tqdm import tqdm

    measured, J = jax.jit(jax.vmap(motion.outcome)), step.system.inertia
    ends = [jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), run.state) for k in (0, -1)]
    before, after = (jax.tree.map(np.asarray, measured(J, State(z.q, z.p))) for z in ends)
    grid, few = phases(scenario), _first(scenario, _WATCHED)
    orbit, long_axis = scenario.orbit.elements(), scenario.spin.long_axis
    go = partial(motion.passages, orbit, scenario.order, long_axis)
    count = 3 + len(scenario.arcs_hours) + len(scenario.variant)
    with tqdm(total=count, unit=" passages", disable=None, leave=False) as bar:

        def done(x: Any) -> Any:
            bar.update()
            return x

        mapped = done(go(grid, scenario.times()))
        fine = done(go(few, scenario.times(steps=2 * scenario.steps)))
        arcs = {hours: done(go(few, scenario.times(hours, 2 * scenario.steps))) for hours in scenario.arcs_hours}
        variants = {x.label: done(_varied(scenario, x, len(grid.phi))) for x in scenario.variant}
        slopes = done(motion.slopes(orbit, _SLOPE_ORDER, long_axis, _thinned(scenario, grid), scenario.times()))
    watched = min(_WATCHED, run.state.q.shape[1])
    halved = float(np.max(_angles(fine.q[:watched], run.state.q[-1, :watched])))
    failed = sum(int((~x.converged).sum()) for x in (mapped, fine, *arcs.values(), *variants.values()))
    return Study(before, after, grid, mapped, slopes, halved, arcs, variants, failed)


_angles = jax.jit(jax.vmap(so3.angle))


def phases(scenario: Scenario) -> Spin:
    """The nominal spin at the phases of the map, φ slowest."""
    given = [getattr(scenario.spin, name).value for name in Changes.model_fields]
    n, m = scenario.map.precession_phases, scenario.map.rotation_phases
    phi, psi = np.meshgrid(2 * np.pi * np.arange(n) / n, np.pi * np.arange(m) / m, indexing="ij")
    same = [np.full(phi.size, x) for x in (*given[:4], *np.deg2rad(given[4:]))]
    return Spin(*map(jnp.asarray, (*same, phi.ravel(), psi.ravel())))


def _thinned(scenario: Scenario, grid: Any) -> Any:
    """Every second value of both phases."""
    n, m = scenario.map.precession_phases, scenario.map.rotation_phases
    return jax.tree.map(lambda x: x.reshape(n, m)[::2, ::2].ravel(), grid)


def _first(scenario: Scenario, count: int) -> Spin:
    """So many members: of as many draws as the run has, if these are enough, as there is a program for them."""
    enough = scenario.model_copy(update={"members": max(count, scenario.members)})
    return jax.tree.map(lambda x: x[:count], members(enough)[0])


def _varied(scenario: Scenario, variant: Variant, count: int) -> Passage:
    """The passages of members under other assumptions."""
    given = {name: getattr(variant, name) for name in Changes.model_fields}
    spin = scenario.spin.model_copy(update={name: x for name, x in given.items() if x is not None})
    orbit = scenario.orbit.model_copy(update={"frame": variant.frame or scenario.orbit.frame})
    spins = _first(scenario.model_copy(update={"spin": spin}), count)
    return motion.passages(orbit.elements(), scenario.order, spin.long_axis, spins, scenario.times())


class Change(NamedTuple):
    """The change of members by a passage.

    Attributes:
        momentum, rate: |π| and 2H/|π| after, over those before.
        turn, longitude, latitude: of the pole, in degrees; latitude is the change of its distance from the ecliptic.
        kept: whether the mode is the same.
    """

    momentum: np.ndarray
    rate: np.ndarray
    turn: np.ndarray
    longitude: np.ndarray
    latitude: np.ndarray
    kept: np.ndarray


def change(before: Outcome, after: Outcome) -> Change:
    """What became of the members."""
    longitudes, latitudes = zip(*(lonlat(x.pole) for x in (before, after)), strict=True)
    turn = np.rad2deg(_turns(before.pole, after.pole))
    return Change(
        after.momentum / before.momentum,
        after.rate / before.rate,
        turn,
        (longitudes[1] - longitudes[0] + 180) % 360 - 180,
        abs(latitudes[1]) - abs(latitudes[0]),
        after.long_axis == before.long_axis,
    )


_turns = jax.jit(jax.vmap(motion.angle))


def lonlat(pole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude in degrees."""
    return np.rad2deg(np.arctan2(pole[:, 1], pole[:, 0])) % 360, np.rad2deg(np.arcsin(np.clip(pole[:, 2], -1, 1)))


def report(scenario: Scenario, step: Step, run: Trajectory) -> str:
    """The passage, periods, spin rates and poles before and after beside published ones, sensitivities and errors."""
    found = study(scenario, step, run)
    lines = [
        *_known(scenario, found, step),
        *_after(scenario, found),
        *_expectations(scenario, found),
        *_by_phase(scenario, found),
        *_sensitivity(scenario, found),
        *_errors(scenario, found),
        *_variants(scenario, found),
        f"\n  {found.failed} of these passages had a step that did not converge",
    ]
    return "\n".join(line.rstrip() for line in lines)


def facts(scenario: Scenario, before: Outcome) -> dict[str, tuple[str, np.ndarray]]:
    """What is known before the passage: a name and the values of the members."""
    orbit = GivenOrbit(scenario.orbit.elements())
    position, velocity = (np.asarray(x) for x in orbit(jnp.zeros(())))
    date = scenario.orbit.date(0)
    a = scenario.orbit.elements()[1]
    alone: dict[str, tuple[str, float]] = {
        "perigee_distance_km": ("distance at the perigee (km)", float(np.linalg.norm(position))),
        "perigee_speed_km_s": ("speed at the perigee (km/s)", float(np.linalg.norm(velocity)) / _HOUR),
        "speed_far_km_s": ("speed far away (km/s)", float(np.sqrt(-scenario.orbit.gm_km3_s2 / a))),
        "perigee_time_utc_h": (
            "time of the perigee (h, UTC)",
            date.hour + date.minute / 60 + date.second / _HOUR,
        ),
    }
    return {key: (name, np.array([x])) for key, (name, x) in alone.items()} | {
        "precession_period_h": ("precession period P_φ (h)", before.precession),
        "rotation_period_h": ("rotation period P_ψ (h)", before.rotation),
        "lightcurve_period_h": (
            "1/(1/P_φ − 1/P_ψ), strongest in light curves (h)",
            1 / (1 / before.precession - 1 / before.rotation),
        ),
        "energy_ratio": ("energy over the least at this |L|", before.excitation),
    }


def _known(scenario: Scenario, found: Study, step: Any) -> list[str]:
    date, hours = scenario.orbit.date, scenario.hours
    redrawn = 1 - members(scenario)[1].mean()
    lines = [
        f"\n  from {date(-hours):%Y-%m-%d %H:%M} to {date(hours):%Y-%m-%d %H:%M} UTC; "
        f"perigee {date(0):%Y-%m-%d %H:%M:%S} UTC",
        f"  {100 * redrawn:.1f} % of the moments were drawn again: no {scenario.spin.mode} mode has such periods",
        f"\n  {'before':<52}{'nominal':>11}{'± members':>12}   published ({scenario.sigmas:g} sigma)",
    ]
    for key, (name, x) in facts(scenario, found.before).items():
        spread = f"{np.std(x, ddof=1):.4f}" if len(x) > 1 else ""
        given = [k for k in scenario.published if k.quantity == key]
        errors = [f" ± {k.error:g}" if k.error else "" for k in given]
        cited = [f"{k.value:g}{e}  ({scenario.source(k.source)})" for k, e in zip(given, errors, strict=True)]
        lines += [f"  {name:<52}{x[0]:>11.4f}{spread:>12}   {(cited or [''])[0]}"]
        lines += [f"  {'':<52}{'':>11}{'':>12}   {text}" for text in cited[1:]]
    return lines


def _row(name: str, x: np.ndarray, form: str = "9.3f") -> str:
    found = [*np.quantile(x, _QUANTILES), x.min(), x.max()] if x.size else [np.nan] * 5
    return f"  {name:<52}" + "".join(f"{value:>{form}}" for value in found)


def _after(scenario: Scenario, found: Study) -> list[str]:
    changed, after = change(found.before, found.after), found.after
    short = ~after.long_axis
    return [
        f"\n  {'after, members of the run':<52}{'5 %':>9}{'median':>9}{'95 %':>9}{'least':>9}{'most':>9}",
        _row("P_φ (h)", after.precession),
        _row("P_ψ (h)", after.rotation, "9.1f"),
        _row("P_φ of short-axis modes (h)", after.precession[short]),
        _row("P_φ of long-axis modes (h)", after.precession[~short]),
        _row("|L| over that before", changed.momentum),
        _row("effective spin rate 2H/|L| over that before", changed.rate),
        _row("energy over the least at this |L|", after.excitation),
        _row("pole turned by (°)", changed.turn),
        _row("pole's longitude changed by (°)", changed.longitude, "9.1f"),
        _row("pole's distance from the ecliptic changed by (°)", changed.latitude, "9.2f"),
        f"  {100 * short.mean():.1f} % end in a short-axis mode, {100 * (~short).mean():.1f} % in a long-axis mode",
    ]


def _expectations(scenario: Scenario, found: Study) -> list[str]:
    x = change(found.before, found.after)
    share = lambda condition: f"{100 * np.mean(condition):.1f} %"  # noqa: E731
    low, high = np.quantile(x.rate, (0.05, 0.95))
    ours = {
        "rate": f"× {low:.2f} to × {high:.2f} (5 to 95 %), × {x.rate.min():.2f} to × {x.rate.max():.2f} in all; "
        f"halved or less in {share(x.rate <= 0.5)}, doubled or more in {share(x.rate >= 2)}",
        "turn": f"median {np.median(x.turn):.1f}°; 10° or more in {share(x.turn >= 10)}",
        "longitude": f"it increases in {share(x.longitude > 0)}",
        "latitude": f"it moves closer in {share(x.latitude < 0)}",
        "mode": f"kept in {share(x.kept)}",
    }
    lines = ["\n  published expectations, and the members of the run"] if scenario.expected else []
    for expected in scenario.expected:
        lines += [f"  {expected.claim}  ({scenario.source(expected.source)})"]
        lines += textwrap.wrap(ours[expected.quantity], 112, initial_indent="    here: ", subsequent_indent="    ")
    return lines


def _by_phase(scenario: Scenario, found: Study) -> list[str]:
    x, after = change(found.mapped.before, found.mapped.after), found.mapped.after
    phi, psi = (np.rad2deg(np.asarray(x)) for x in (found.grid.phi, found.grid.psi))
    lines = [
        f"\n  {f'nominal body, {len(phi)} pairs of phases':<52}{'value':>9}   at φ, ψ and at φ + 180°, ψ + 180° (°)"
    ]
    for name, values in (
        ("P_φ after (h)", after.precession),
        ("effective spin rate over that before", x.rate),
        ("pole turned by (°)", x.turn),
    ):
        for which, k in (("least", values.argmin()), ("most", values.argmax())):
            lines.append(f"  {f'{name}, {which}':<52}{values[k]:>9.3f}   {phi[k]:.0f}, {psi[k]:.0f}")
    for name, held in (
        ("spin rate halved or less", x.rate <= 0.5),
        ("spin rate below × 0.75", x.rate <= 0.75),
        ("spin rate above × 1.5", x.rate >= 1.5),
        ("spin rate doubled or more", x.rate >= 2),
        ("long-axis mode after", after.long_axis),
    ):
        where = f"φ mod 180° within {_interval(phi[held])}" if held.any() else "at no phase"
        lines.append(f"  {name:<52}{100 * held.mean():>7.1f} %   {where}")
    return lines


def _interval(phi: np.ndarray) -> str:
    """The shortest interval modulo 180° that holds angles in degrees."""
    x = np.unique(np.round(phi % 180, 9))
    gaps = np.diff(np.append(x, x[0] + 180))
    k = int(gaps.argmax())
    first, last = x[(k + 1) % len(x)], x[k]
    return f"{first if last >= first else first - 180:.0f}° to {last:.0f}°"


def _sensitivity(scenario: Scenario, found: Study) -> list[str]:
    lines = [
        "\n  sensitivities over the map, by forward differentiation of the whole passage: median and largest",
        f"  {'by':<28}{'dP_φ (h)':>18}{'dP_ψ (h)':>22}{'d ln(spin rate)':>22}{'d pole (°)':>20}",
    ]
    rate = _thinned(scenario, found.mapped.after.rate)
    for name, (unit, size, _) in _steps(scenario).items():
        x = abs(getattr(found.slopes, name)) * size
        scaled = (x[:, 0], x[:, 1], x[:, 2] / rate, np.rad2deg(x[:, 3]))
        lines.append(f"  {unit:<28}" + "".join(f"{np.median(v):>11.3g} {v.max():>9.3g}" for v in scaled))
    return lines


def _steps(scenario: Scenario) -> dict[str, tuple[str, float, float]]:
    """By part of `Slopes`: the change that the report takes, in words and in its unit, and one standard deviation."""
    given, degree = scenario.spin, np.deg2rad(1.0)
    sigma = {name: sum(getattr(given, name).sides()) / 2 / scenario.sigmas for name in Changes.model_fields}
    east = sigma["momentum_longitude_deg"] / np.cos(np.deg2rad(given.momentum_latitude_deg.value))
    return {
        "phi": ("1° of φ", degree, np.pi / np.sqrt(3)),
        "psi": ("1° of ψ", degree, np.pi / np.sqrt(3)),
        "least": ("0.01 of I₁/I₃", 0.01, sigma["least_moment"]),
        "middle": ("0.001 of I₂/I₃", 0.001, sigma["middle_moment"]),
        "precession": ("0.01 h of P_φ before", 0.01, sigma["precession_period_h"]),
        "rotation": ("1 h of P_ψ before", 1.0, sigma["rotation_period_h"]),
        "longitude": ("1° of the pole's longitude", degree, np.deg2rad(east)),
        "latitude": ("1° of the pole's latitude", degree, np.deg2rad(sigma["momentum_latitude_deg"])),
        "perigee": ("1 km of the perigee", 1.0, 0.0),
    }


def _errors(scenario: Scenario, found: Study) -> list[str]:
    longest = max(found.arcs)
    best = found.arcs[longest].after
    heads = ("P_φ (h)", "P_ψ (%)", "2H/|L| (%)", "pole (°)")
    lines = [
        f"\n  attitude at the end, {scenario.steps} steps and twice as many: {found.halved:.1e} rad, the largest of "
        f"{min(_WATCHED, len(found.before.rate))} members",
        f"\n  {f'arcs against ± {longest:g} h, {len(best.rate)} members':<34}" + "".join(f"{x:>20}" for x in heads),
        f"  {'':<34}" + f"{'median':>11}{'largest':>9}" * 4,
    ]
    for hours, passage in found.arcs.items():
        if hours == longest:
            continue
        x = passage.after
        turn = np.rad2deg(_turns(x.pole, best.pole))
        parts = (
            abs(x.precession - best.precession),
            100 * abs(x.rotation / best.rotation - 1),
            100 * abs(x.rate / best.rate - 1),
            turn,
        )
        lines.append(f"  {f'± {hours:g} h':<34}" + "".join(f"{np.median(v):>11.2g}{v.max():>9.2g}" for v in parts))
    return lines


def _variants(scenario: Scenario, found: Study) -> list[str]:
    heads = {"P_φ (h)": 22, "spin rate": 20, "pole turned (°)": 22, "kept mode": 11}
    title = "other assumptions: 5 %, median, 95 %"
    lines = [f"\n  {title:<42}" + "".join(f"{head:>{width}}" for head, width in heads.items())]
    cases = {"the run": (found.before, found.after)}
    cases |= {name: (passage.before, passage.after) for name, passage in found.variants.items()}
    for name, (before, after) in cases.items():
        x = change(before, after)
        columns = [(after.precession, 22, ".1f"), (x.rate, 20, ".2f"), (x.turn, 22, ".1f")]
        text = "".join(
            f"{', '.join(format(v, form) for v in np.quantile(values, _QUANTILES)):>{width}}"
            for values, width, form in columns
        )
        lines.append(f"  {name:<42}{text}{100 * np.mean(x.kept):>9.1f} %")
    return lines


def draw_map(scenario: Scenario, step: Step, run: Trajectory) -> Figure:
    """Plot, over both phases at the perigee, periods, effective spin rate and turn of the pole after the passage."""
    found = study(scenario, step, run)
    x, after = change(found.mapped.before, found.mapped.after), found.mapped.after
    fig, axes = plots.figure(2, 2)
    fig.set_size_inches(9.2, 7.4)
    shape = (scenario.map.precession_phases, scenario.map.rotation_phases)
    before = found.mapped.before
    panels = (
        ("effective spin rate $2H/|L|$ over that before", x.rate, "PuOr_r", (0.5, 0.6, 0.75, 1, 1.25, 1.5, 2), True),
        (
            f"precession period $P_\\phi$ (h); before {before.precession[0]:.2f}",
            after.precession,
            "viridis",
            (18, 20, 24, 28, 32, 36, 40),
            False,
        ),
        (
            f"rotation period $P_\\psi$ (h), 500 and more alike; before {before.rotation[0]:.0f}",
            np.clip(after.rotation, None, 500),
            "cividis",
            (),
            False,
        ),
        ("pole turned by (°)", x.turn, "magma", (5, 10, 15, 20, 25, 30), False),
    )
    for ax, (title, values, colours, levels, middle) in zip(axes.flat, panels, strict=True):
        _draw_phases(fig, ax, values.reshape(shape), after.long_axis.reshape(shape), colours, levels, middle)
        ax.set_title(title, fontsize="medium")
    for ax in axes[1]:
        ax.set_xlabel("precession phase $\\phi$ at the perigee (°)")
    for ax in axes[:, 0]:
        ax.set_ylabel("rotation phase $\\psi$ at the perigee (°)")
    fig.suptitle(
        f"{scenario.title}: nominal body, every phase; hatched: it ends in a long-axis mode", fontsize="medium"
    )
    return fig


def _draw_phases(fig: Figure, ax: Any, values: Any, long_axis: Any, colours: str, levels: Any, middle: bool) -> None:
    """A map over φ and ψ, both to 360°: the second half is the first with both phases 180° on."""
    from matplotlib.patheffects import withStroke

    n, m = values.shape

    def whole(x: np.ndarray) -> np.ndarray:
        full = np.concatenate([x, np.roll(x, n // 2, axis=0)], axis=1)
        return np.pad(full, ((0, 1), (0, 1)), mode="wrap").T

    phi, psi = np.linspace(0, 360, n + 1), np.linspace(0, 360, 2 * m + 1)
    options: dict[str, Any] = {"cmap": colours, "shading": "gouraud", "rasterized": True}
    if middle:
        from matplotlib.colors import LogNorm

        most = max(abs(np.log(values)).max(), np.log(1.2))
        options["norm"] = LogNorm(np.exp(-most), np.exp(most))
    image = ax.pcolormesh(phi, psi, whole(values), **options)
    bar = fig.colorbar(image, ax=ax)
    shown = [level for level in levels if values.min() < level < values.max()]
    if middle:
        bar.set_ticks(shown, labels=[f"{level:g}" for level in shown])
        bar.ax.minorticks_off()
    if shown:
        lines = ax.contour(phi, psi, whole(values), shown, colors=plots.INK, linewidths=0.6)
        outline = [withStroke(linewidth=2, foreground="white")]
        for text in ax.clabel(lines, fontsize="x-small", fmt="%g"):
            text.set_path_effects(outline)
    if long_axis.any():
        mode = whole(long_axis.astype(float))
        hatched = ax.contourf(phi, psi, mode, [0.5, 1.5], hatches=["///"], colors="none")
        hatched.set(edgecolor="white", linewidth=0)
        ax.contour(phi, psi, mode, [0.5], colors="white", linewidths=1.4)
    ax.set_xticks(range(0, 361, 90))
    ax.set_yticks(range(0, 361, 90))


def draw_after(scenario: Scenario, step: Step, run: Trajectory) -> Figure:
    """Plot the distributions of the members after the passage: periods, spin rate, turn of the pole, and the poles."""
    found = study(scenario, step, run)
    x, after, before = change(found.before, found.after), found.after, found.before
    fig, axes = plots.figure(3, 2)
    fig.set_size_inches(12, 7)
    panels = (
        ("precession period $P_\\phi$ (h)", after.precession, before.precession[0]),
        ("rotation period $P_\\psi$ (h)", after.rotation, before.rotation[0]),
        ("$|L|$ over that before", x.momentum, 1.0),
        ("effective spin rate $2H/|L|$ over that before", x.rate, 1.0),
        ("pole turned by (°)", x.turn, None),
    )
    for ax, (label, values, was) in zip(axes.flat, panels, strict=False):
        top = np.quantile(values, 0.99)
        bins = np.linspace(values.min(), top + 0.02 * np.ptp(values[values <= top]), 50)
        parts = [values[~after.long_axis], values[after.long_axis]]
        ax.hist(parts, bins, stacked=True, color=[plots.BLUE, plots.RED], label=["short-axis mode", "long-axis mode"])
        if was is not None:
            ax.axvline(was, color=plots.INK, ls="--", lw=1.0, label="before (nominal)")
        ax.set(xlabel=label, ylabel="members")
    axes[0, 0].legend(frameon=False, fontsize="x-small")
    axes[1, 2].remove()
    _draw_poles(fig.add_subplot(2, 3, 6, projection="polar"), before, after)
    fig.suptitle(f"{scenario.title}: {len(after.rate)} members, phases uniform", fontsize="medium")
    return fig


def _draw_poles(ax: Any, before: Outcome, after: Outcome) -> None:
    """The poles on the sky about the nearer pole of the ecliptic."""
    side = np.sign(before.pole[0, 2]) or 1.0
    for outcome, colour, label in ((after, plots.RED, "after"), (before, plots.BLUE, "before")):
        longitude, latitude = lonlat(outcome.pole)
        ax.scatter(np.deg2rad(longitude), 90 - side * latitude, s=1.0, lw=0, color=colour, alpha=0.35, rasterized=True)
        ax.plot([], [], "o", ms=4, color=colour, label=label)
    ax.set_rlim(0, None)
    ax.set_rlabel_position(22.5)
    ax.tick_params(labelsize="x-small")
    ax.set_title(
        f"direction of $L$: longitude, and ° from\nthe {'north' if side > 0 else 'south'} pole of the ecliptic",
        fontsize="small",
    )
    ax.legend(frameon=False, fontsize="x-small", loc="lower left", bbox_to_anchor=(-0.3, -0.12))


def draw_sensitivity(scenario: Scenario, step: Step, run: Trajectory) -> Figure:
    """Plot what one standard deviation of each unknown does to the periods, to first order, over the phases."""
    found = study(scenario, step, run)
    fig, axes = plots.figure(2)
    fig.set_size_inches(9.2, 3.8)
    names = {
        "phi": "φ, uniform",
        "psi": "ψ, uniform",
        "least": "moment I₁/I₃",
        "middle": "moment I₂/I₃",
        "precession": "$P_\\phi$ before",
        "rotation": "$P_\\psi$ before",
        "longitude": "pole's longitude",
        "latitude": "pole's latitude",
    }
    sizes = {name: sigma for name, (_, _, sigma) in _steps(scenario).items() if sigma > 0}
    for ax, k, label in ((axes[0, 0], 0, "change of $P_\\phi$ (h)"), (axes[0, 1], 1, "change of $P_\\psi$ (h)")):
        shown = [
            np.maximum(abs(getattr(found.slopes, name)[:, k]) * sizes[name], 1e-12) for name in names if name in sizes
        ]
        ax.boxplot(
            shown,
            orientation="horizontal",
            whis=(5, 95),
            showfliers=False,
            medianprops={"color": plots.RED},
            tick_labels=[text for name, text in names.items() if name in sizes],
        )
        ax.invert_yaxis()
        ax.set_xscale("log")
        ax.set_xlabel(f"{label}, 1 sigma of the unknown")
        ax.grid(True, axis="x", lw=0.3, color=plots.GREY)
    axes[0, 1].set_yticklabels([])
    fig.suptitle("To first order, over all phases: 5 %, quartiles and 95 %", fontsize="medium")
    return fig


PICTURES = {"map": draw_map, "after": draw_after, "sensitivity": draw_sensitivity}
