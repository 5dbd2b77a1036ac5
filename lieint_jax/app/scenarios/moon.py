"""The rotation of a moon in an eccentric orbit: its surface of section, its Lyapunov exponents, observed states.

Units: the orbit's mean motion n and semi-major axis are 1, so time is counted in 1/n and exponents in n. Members start
at pericenter, spin about the axis of greatest inertia along the orbit's normal, and stay planar; a state saved at every
pericenter is a point of the section (θ, θ̇), θ the angle of the long axis from the line of apsides.
"""

from __future__ import annotations

import functools
import math
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax import _checks, orbits, plots, schemes, systems
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._kind import Kind, for_last_run, picture
from lieint_jax.app.scenarios._report import paragraphs
from lieint_jax.app.scenarios._runs import map_on_local_devices, standard_deviation
from lieint_jax.diagnostics import Lyapunov, lyapunov
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.systems import GravityGradient
from lieint_jax.types import State, Step

_PERIOD = 2 * np.pi  # of the orbit
_CHAOTIC = 3.0  # a motion counts as chaotic above this many times ln(t)/t, the exponent of regular motions
_MAJORITY = 0.95  # share of chaotic members above which a state is chaotic; below 1 − _MAJORITY it may be regular
_COLORS = plots.COLORS[1:]  # of regular motions
_ROUND_OFF = 1e-9  # an angle closer to π is 0
_IN_PLANE, _OUT_OF_PLANE = (2, 5), (0, 1, 3, 4)  # coordinates (δθ, δπ), which do not mix along a planar motion
_IN_AND_OUT = "in the plane", "out of the plane: attitude unstable if > 0"

Eccentricity = Annotated[float, Field(ge=0, lt=1)]


class Sample(keys.Table):
    """The number of chaotic motions that are integrated, and their length."""

    starts: keys.PositiveInt
    """The number of motions, those of the section's chaotic members."""
    orbits: keys.PositiveInt
    """The length of each motion."""


class Observed(keys.Table):
    """An observed rotation state, and the assumed principal axes."""

    date: str
    """The date of the observation."""
    reading: str
    """A short name of the assumption on the principal axes."""
    inertia: keys.Moments
    """Principal moments about the axes a, b, c."""
    eccentricity: Eccentricity
    """The eccentricity of the orbit at that date."""
    mean_anomaly_deg: float
    """The mean anomaly at that date, in degrees."""
    euler_313_deg: keys.Triple
    """Attitude R_z(α) R_x(β) R_z(γ), axes a, b, c to space, in degrees; in space x is toward pericenter, z normal."""
    spin_axis: keys.Direction
    """The direction of the angular velocity, components along a, b, c; of any length."""
    spin_rate: keys.PositiveFloat
    """The size of the angular velocity, in mean motions."""
    source: keys.Source


class Ensemble(keys.Table):
    """Members about each observed state, an assumption on its errors."""

    members: keys.PositiveInt
    """The number of members of each; the first is the state itself."""
    orbits: keys.PositiveInt
    """The length of a run."""
    steps_per_orbit: keys.PositiveInt
    """The period over the step size: fast spin needs more steps than planar motions."""
    attitude_deg: keys.NonNegative = 0.0
    """Standard deviation of a rotation about each axis of space, in degrees."""
    spin_axis_deg: keys.NonNegative = 0.0
    """Standard deviation of the spin axis in the body, about each of two axes, in degrees."""
    spin_rate: keys.NonNegative = 0.0
    """Standard deviation of the spin rate, in mean motions."""


def _check_in_order(moments: list[float]) -> None:
    if not moments[0] < moments[1] <= moments[2]:
        raise ValueError("must be three moments in order, the first the least")


class Moon(Kind):
    """The keys of a scenario of this kind."""

    dt: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Follows from steps_per_orbit; files of results have it."""
    period: keys.PositiveFloat
    """The period of the orbit, in period_unit: for times in reports."""
    period_unit: str = "d"
    """The name of that unit."""
    inertia: Annotated[keys.Moments, keys.checked(_check_in_order)]
    """Principal moments of the planar motions, the axes of the least and the greatest first and last."""
    eccentricity: Eccentricity
    """The eccentricity of the orbit of the planar motions."""
    steps_per_orbit: keys.PositiveInt
    """The period over the step size; a state is saved at every pericenter."""
    angles: keys.PositiveInt
    """The number of starts with one rate: θ = 0 … π; members is a multiple of it."""
    greatest_rate: keys.PositiveFloat
    """Starts have rates θ̇ = 0 … greatest_rate, in mean motions."""
    planar: Sample
    """The sample of the planar exponents."""
    spatial: Sample
    """The sample of the exponents of motions in space: the same starts, tilted by tilt_deg."""
    tilt_deg: keys.PositiveFloat = 5.0
    """In degrees."""
    around: Ensemble
    """About the observed states."""
    observed: list[Observed] = []
    """Observed states."""
    notes: list[keys.Text] = []
    """Paragraphs of the report below the observed states: the assumptions."""

    no_spread: ClassVar[str] = (
        "the members are a grid of planar starts; members about observed states are spread by the table around"
    )

    def _check_steps_per_orbit(self) -> None:
        dt = _PERIOD / self.steps_per_orbit
        if self.dt is not None and self.dt != dt:
            raise ValueError("dt is given by steps_per_orbit: leave it out")
        if self.steps % self.steps_per_orbit:
            raise ValueError(f"steps = {self.steps} must be whole orbits of steps_per_orbit = {self.steps_per_orbit}")
        if self.members % self.angles:
            near = _checks.nearest_multiples(self.members, self.angles)
            raise ValueError(f"members = {self.members} must be a multiple of angles = {self.angles}: give {near}")
        self.dt, self.save_every = dt, self.steps_per_orbit  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def orbits(self) -> int:
        """The length of the section's motions."""
        return self.steps // self.steps_per_orbit

    def assumption(self) -> str:
        a = self.around
        return (
            f"planar starts: {self.angles} angles × {self.members // self.angles} rates; about each observed state "
            f"{a.members} members, an assumption: {a.attitude_deg:g}° of attitude, {a.spin_axis_deg:g}° of "
            f"the spin axis, {a.spin_rate:g} n of its rate (1 sigma, each component)"
        )

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The step and the planar starts, which share their time."""
        step = make_step(self.inertia, self.eccentricity)
        number = self.indices(indices)
        rates = max(self.members // self.angles, 2)
        theta = np.pi / self.angles * (number % self.angles)
        rate = self.greatest_rate / (rates - 1) * (number // self.angles)
        zero = np.zeros_like(theta)
        q = jnp.asarray(np.stack([np.cos(theta / 2), zero, zero, np.sin(theta / 2)], axis=1))
        states = _states(step.system, q, jnp.asarray(np.stack([zero, zero, rate], axis=1)), 0.0)
        return step, states._replace(work=jnp.zeros(len(number)))

    @for_last_run
    def chaos(self, run: Run) -> Chaos:
        """The exponents of a run."""
        starts = State(jnp.asarray(run.state.q[0]), jnp.asarray(run.state.p[0]), jnp.asarray(run.t[0]))
        planes = np.zeros((6, 2))
        planes[_IN_PLANE, 0] = planes[_OUT_OF_PLANE, 1] = 1
        per_orbit = self.steps_per_orbit
        found = [section := _exponents(run.step, starts, self.orbits, per_orbit, planes)]
        growth = np.asarray(section.exponents[:, 0])
        chaotic = growth[growth > chaos_limit(self.orbits)]
        # the large chaotic zone, without thin layers
        zone = np.flatnonzero(growth > np.median(chaotic) / 2) if chaotic.size else np.zeros(0, int)
        planar = spatial = np.zeros((0, 6))
        if zone.size:
            drawn = _select_evenly(starts, zone, self.planar.starts)
            found.append(in_plane := _exponents(run.step, drawn, self.planar.orbits, per_orbit, planes))
            tilt = so3.exp(jnp.deg2rad(self.tilt_deg) * jnp.array([1.0, 0.0, 0.0]))
            drawn = _select_evenly(starts, zone, self.spatial.starts)
            drawn = drawn._replace(q=jax.vmap(lambda q: so3.multiply(tilt, q))(drawn.q))
            found.append(in_space := _exponents(run.step, drawn, self.spatial.orbits, per_orbit, np.eye(6)))
            planar, spatial = np.asarray(in_plane.exponents), np.sort(np.asarray(in_space.exponents), axis=1)[:, ::-1]
        observed = [self._exponents_about(k) for k in range(len(self.observed))]
        failed = sum(int((~np.asarray(x.info.converged)).sum()) for x in (*found, *observed))
        exponents, errors = (np.array([np.asarray(x[k])[:, 0] for x in observed]) for k in (0, 1))
        return Chaos(np.asarray(section.exponents), planar, spatial, exponents, errors, failed)

    def _exponents_about(self, k: int) -> Lyapunov:
        """The largest exponents of the members about the k-th observed state."""
        given, spread = self.observed[k], self.around
        step = make_step(given.inertia, given.eccentricity)
        normal = np.random.default_rng([self.seed, k]).normal(size=(spread.members, 7))
        rotation, tilt, rate = np.split(normal, [3, 6], axis=1)
        rotation[0] = tilt[0] = rate[0] = 0
        q = so3.from_euler_313(jnp.deg2rad(jnp.asarray(given.euler_313_deg)))
        q = jax.vmap(lambda v: so3.multiply(so3.exp(v), q))(jnp.asarray(np.deg2rad(spread.attitude_deg) * rotation))
        axis = np.asarray(given.spin_axis) / np.linalg.norm(given.spin_axis)
        axes = axis + np.deg2rad(spread.spin_axis_deg) * (tilt - (tilt @ axis)[:, None] * axis)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        Omega = (given.spin_rate + spread.spin_rate * rate) * axes
        states = _states(step.system, q, jnp.asarray(Omega), np.deg2rad(given.mean_anomaly_deg))
        return _exponents(step, states, spread.orbits, spread.steps_per_orbit, np.ones((6, 1)))

    def report(self, run: Run) -> str:
        """The exponents of planar motions, of motions in space, and of the observed states, with their errors."""
        found, unit = self.chaos(run), self.period_unit
        return "\n".join(
            [
                f"\n  exponents in mean motions n = 2π / {self.period:g} {unit}; chaotic: above {_CHAOTIC:g} ln(t)/t",
                *self._planar_lines(found),
                *self._observed_lines(found),
                *paragraphs(self.notes),
                f"\n  {found.failed} of these runs had a step that did not converge",
            ]
        )

    def _planar_lines(self, found: Chaos) -> list[str]:
        chaotic = found.section[:, 0] > chaos_limit(self.orbits)
        unstable = found.section[:, 1] > chaos_limit(self.orbits)
        lines = [
            f"\n  planar motions, {self.members} starts × {self.orbits} orbits",
            f"  {'chaotic':<58}{_percent(chaotic):>8}",
            f"  {'of the regular ones, attitude unstable':<58}{_percent(unstable[~chaotic]):>8}",
        ]
        tables: dict[str, Any] = {
            "planar motions in the chaotic zone": (found.planar, self.planar, _IN_AND_OUT),
            "motions in space from there": (found.spatial, self.spatial, ("1st", "2nd", "3rd", "4th", "5th", "6th")),
        }
        for space, (values, sample, name) in tables.items():
            if len(values):
                title = f"{space}, {len(values)} starts × {sample.orbits} orbits"
                lines.append(f"\n  {title:<68}{'mean ± error':>10}{'spread':>9}{'e-folding':>12}")
                lines += [
                    f"  {what:<46}{x.mean():>+10.4f} ± {_standard_error(x):.4f}{standard_deviation(x):>10.4f}"
                    + f"{self._e_folding_time(x.mean()):>12}"
                    for what, x in zip(name, values.T, strict=True)
                ]
        if len(found.spatial):
            lines.append(f"  {'largest sum of six':<48}{abs(found.spatial.sum(axis=1)).max():>10.1e} n")
        return lines

    def _observed_lines(self, found: Chaos) -> list[str]:
        bound = chaos_limit(self.around.orbits)
        lines = [
            f"\n  observed states, {self.around.members} members × {self.around.orbits} orbits; "
            f"chaotic: largest exponent above {bound:.4f} n",
            f"  {'date':<12}{'principal axes':<32}{'nominal':>17}{'mean of members':>20}{'e-folding':>12}"
            f"{'chaotic':>9}",
        ]
        for given, x, error in zip(self.observed, found.observed, found.errors, strict=True):
            mean = f"{x.mean():>11.4f} ± {_standard_error(x):.4f}"
            lines.append(
                f"  {given.date:<12}{given.reading:<32}{x[0]:>8.4f} ± {error[0]:.4f}{mean}"
                f"{self._e_folding_time(x.mean()):>12}{_percent(x > bound):>9}  {verdict(x, bound)}"
            )
        return lines if self.observed else []

    def _e_folding_time(self, exponent: float) -> str:
        """The time in which small differences grow by the factor e."""
        return f"{self.period / (_PERIOD * exponent):.0f} {self.period_unit}" if exponent > 0 else "—"

    @picture(3, size=(4.6, 5.2))
    def draw_section(self, axes: np.ndarray, run: Run) -> None:
        """Plot the surface of section at pericenter, and maps of the exponents in the plane and out of it."""
        found = self.chaos(run)
        chaotic = found.section[:, 0] > chaos_limit(self.orbits)
        theta, rate = self.section(run.state)
        left, *maps = axes
        left.scatter(theta[:, chaotic], rate[:, chaotic], s=0.15, color=plots.GRAY, lw=0, rasterized=True)
        for m in np.flatnonzero(~chaotic):
            left.scatter(theta[:, m], rate[:, m], s=0.4, lw=0, rasterized=True, color=_COLORS[m % len(_COLORS)])
        left.set_ylabel("spin rate θ̇ / n")
        left.set_title("surface of section at pericenter; gray: chaotic\nmotions, colors: regular motions, one each")
        names = ("in the plane", "out of the plane: the spin axis leaves its normal")
        scale = {"vmin": 0, "vmax": found.section.max(), "cmap": "magma"}
        images = []
        for ax, name, values in zip(maps, names, found.section.T, strict=True):
            x, y, value = (self._rows(grid) for grid in (theta[0], rate[0], values))
            x[:, -1] += np.pi
            images.append(ax.pcolormesh(x, y, value, shading="nearest", **scale))
            ax.set_title(f"Lyapunov exponent / n,\n{name}")
        left.figure.colorbar(images[0], ax=maps[1], label="Lyapunov exponent / n")
        for ax in axes:
            ax.set(xlabel="θ, long axis from the line of apsides", xlim=(0, np.pi), ylim=(0, self.greatest_rate))
            ax.set_xticks(np.pi * np.arange(5) / 4, ["0", "π/4", "π/2", "3π/4", "π"])
        left.figure.suptitle(f"{self.title}: {self.members} planar motions, {self.orbits} orbits each")

    def _rows(self, x: np.ndarray) -> np.ndarray:
        """Values of the members as a grid, a row for each rate; its last column repeats the first: θ has period π."""
        grid = x.reshape(-1, self.angles)
        return np.concatenate([grid, grid[:, :1]], axis=1)

    def section(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """θ in [0, π) and θ̇ of planar states."""
        q, p = np.asarray(state.q), np.asarray(state.p)
        theta = 2 * np.arctan2(q[..., 3], q[..., 0]) % np.pi
        return np.where(theta > np.pi - _ROUND_OFF, 0.0, theta), p[..., 2] / self.inertia[2]

    @picture(size=lambda scenario: (8, 1.2 + 0.42 * max(len(scenario.observed), 3)))
    def draw_observed(self, axes: np.ndarray, run: Run) -> None:
        """Plot the largest exponents of the members about each observed state."""
        found, bound = self.chaos(run), chaos_limit(self.around.orbits)
        ax, scatter = axes[0], np.random.default_rng(0)
        ax.axvspan(0, bound, color=plots.GRAY, alpha=0.35, lw=0, label="not distinguishable from a regular motion")
        for k, (x, error) in enumerate(zip(found.observed, found.errors, strict=True)):
            color = plots.RED if verdict(x, bound) == "chaotic" else plots.BLUE
            ax.plot(x[1:], k + scatter.uniform(-0.2, 0.2, len(x) - 1), "o", ms=3, color=color, alpha=0.6, lw=0)
            ax.errorbar(x[0], k, xerr=error[0], fmt="D", ms=5, color=plots.INK, capsize=2)
        ax.plot([], [], "D", ms=5, color=plots.INK, label="state as observed, ± its error")
        ax.plot([], [], "o", ms=3, color=plots.RED, label="members about it: chaotic as a whole")
        ax.plot([], [], "o", ms=3, color=plots.BLUE, label="members about it: undecided, or regular")
        names = [f"{given.date}\n{given.reading}" for given in self.observed]
        ax.set_yticks(range(len(names)), names, fontsize="x-small")
        ax.invert_yaxis()
        n = f"the mean motion n = 2π / {self.period:g} {self.period_unit}"
        ax.set(xlabel=f"largest Lyapunov exponent / n, with {n}", ylabel="date of the state; its principal axes")
        ax.set(xlim=(0, None), title="the observed states, and members about each")
        ax.legend(loc="lower right")


def make_step(inertia: Any, eccentricity: float) -> Step:
    return schemes.splitting(systems.gravity_gradient(inertia, orbits.kepler(1.0, 1.0, eccentricity)))


def _states(body: GravityGradient, q: Array, Omega: Array, t: float) -> State:
    """States of many members at attitudes (m, 4) with angular velocities (m, 3) in the body, at one time."""
    states = jax.vmap(lambda q, Omega: body.state(q, angular_velocity=Omega, t=t))(q, Omega)
    return states._replace(t=jnp.asarray(t, states.p.dtype))


class Chaos(NamedTuple):
    """The exponents of a scenario's motions, in n."""

    section: np.ndarray  # the exponents of the members, in the plane and out of it, (members, 2)
    planar: np.ndarray  # the same for longer planar motions in the chaotic zone, (starts, 2)
    spatial: np.ndarray  # the spectrum of motions in space from these starts, (starts, 6)
    observed: np.ndarray  # the largest exponents of the members about each observed state, (states, members)
    errors: np.ndarray  # the standard errors of `observed`
    failed: int  # the number of these runs with a step that did not converge


def _select_evenly(states: State, among: np.ndarray, count: int) -> State:
    """Select `count` of the members with the indices `among`, evenly spread, each at most once."""
    chosen = among[np.unique(np.linspace(0, among.size - 1, count).round().astype(int))]
    return states._replace(q=states.q[chosen], p=states.p[chosen])


def _exponents(step: Step, states: State, orbits: int, per_orbit: int, vectors: np.ndarray) -> Lyapunov:
    """The exponents of many members, on all devices, for initial tangent vectors (6, k)."""
    program = _compiled_exponents(orbits * per_orbit, math.gcd(per_orbit, 20))
    return program(step, states, _PERIOD / per_orbit, jnp.asarray(vectors))


@functools.cache
def _compiled_exponents(num_steps: int, every: int) -> Any:
    def exponents_of(step: Step, state: State, dt: Array, vectors: Array) -> Lyapunov:
        return lyapunov(step, state, dt, num_steps, every=every, vectors=vectors)

    return map_on_local_devices(exponents_of, (None, State(0, 0, None), None, None))  # pyright: ignore[reportArgumentType]


def chaos_limit(orbits: int) -> float:
    """The exponent above which a motion of this length counts as chaotic: regular ones reach about ln(t)/t."""
    t = _PERIOD * orbits
    return _CHAOTIC * np.log(t) / t


def verdict(exponents: np.ndarray, bound: float) -> str:
    """Whether the members about a state are chaotic: nearly all of them, nearly none, or undecided."""
    share = np.mean(exponents > bound)
    return "chaotic" if share >= _MAJORITY else "not distinct from regular" if share <= 1 - _MAJORITY else "undecided"


def _standard_error(x: np.ndarray) -> float:
    """The standard error of the mean."""
    return float(standard_deviation(x)) / len(x) ** 0.5


def _percent(x: np.ndarray) -> str:
    return f"{100 * np.mean(x):.0f} %" if x.size else "—"
