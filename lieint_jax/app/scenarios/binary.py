"""Two bodies about one another, a binary asteroid: periods, librations, energies, and the effect of a change of speed.

Units: m, kg and s; reports are in hours and days. At the start the line from the primary to the secondary is the x axis
of space, the secondary moves along y, z is the normal of the orbit, and the barycenter is at rest at the origin. Every
member has its own masses and moments: the leaves of the step have the member axis.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import measure, plots, potentials, runs, systems
from lieint_jax.app.scenarios._body import ExtendedBody, MultibodyKind, member_bodies
from lieint_jax.app.scenarios._keys import DAY, HOUR, NonNegative, NumberSpread, PositiveFloat, Published, Table
from lieint_jax.app.scenarios._kind import check_order, for_last_run, picture, step_of
from lieint_jax.app.scenarios._pictures import draw_errors
from lieint_jax.app.scenarios._report import Conserved, Quantity, citation
from lieint_jax.app.scenarios._runs import as_batch, drawn_steps, length, nominal_state, series, standard_deviation
from lieint_jax.groups import so3
from lieint_jax.measure import RelativeMotion, mean_rate
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run, integrate
from lieint_jax.systems import RigidBodies
from lieint_jax.types import State, Step, vectors

_ENERGY, _MOMENTUM = "energy, over |energy|", "angular momentum, relative"
_SHOWN = {_ENERGY: "H", _MOMENTUM: "L"}  # in the picture of errors
_BRIEF, _FINE = 4, 4  # orbits in the picture of energies; steps of pictures per step of the scenario
_MAX_DRAWN = 100  # members whose range is drawn
_UPRIGHT = 30  # degrees; a secondary of larger obliquity counts as tumbling
_PARTS = {"orbit": "orbit of two points", "spin_1": "primary's spin", "spin_2": "secondary's spin"}  # of the energy
_PARTS |= {"shape": "potential of their shapes, V + G m₁m₂/r"}
_DEG_D = np.rad2deg(DAY)  # of rad/s
_LONG = 8  # length of the spectrum's run, over that of the scenario


class Body(ExtendedBody):
    """One body: mass and moments, or those of a homogeneous ellipsoid; attitude and angular velocity in its axes."""

    relative_to: Literal["space", "orbit"] = "space"
    """What the angular velocity is relative to: the orbit's axes rotate at speed/separation about their z axis."""


class Orbit(Table):
    """The relative motion at the start."""

    separation_m: PositiveFloat
    """The distance of the centers of mass, in m."""
    speed_m_s: PositiveFloat | None = None
    """The relative speed across the line of centers, in m/s; by default that of a circular orbit."""
    speed_change_mm_s: float = 0.0
    """Added to the speed, as by an impact, in mm/s."""


class Spread(NumberSpread):
    """Standard deviations of the members' relative motion about the nominal one, and of numbers by their paths."""

    velocity_mm_s: NonNegative = 0.0
    """Each component of the relative velocity, in mm/s."""


Scheme = Literal["kepler_splitting", "nystrom", "splitting", "bodies_energy_momentum"]
Name = Literal[
    "orbital_period_h",
    "orbital_period_before_h",
    "primary_spin_period_h",
    "apsidal_precession_deg_d",
    "speed_change_mm_s",
]


class Binary(MultibodyKind):
    """The keys of a scenario of this kind."""

    G: PositiveFloat = 6.67430e-11
    """The constant of gravity, in m³ kg⁻¹ s⁻²."""
    scheme: Scheme = "kepler_splitting"
    order: int | list[int] | None = None
    """The order: of kepler_splitting 2, [8, 4] or [8, 6, 4]; of nystrom 4 or 6; of the others 2, 4, 6 or 8."""
    primary: Body
    secondary: Body
    orbit: Orbit
    spread: Spread = Spread()
    published: dict[Name, Published] = {}
    """Periods in hours, rates in degrees a day, changes of speed in mm/s, as the names say."""

    def _check_order(self) -> None:
        check_order(self.scheme, self.order)

    def spreads(self) -> dict[str, tuple[float, str]]:
        pair = {"primary": self.primary, "secondary": self.secondary}
        orbit = {"relative velocity": (self.spread.velocity_mm_s, "mm/s")}
        return orbit | {k: x for name, b in pair.items() for k, x in b.spread.stated("s", f"{name}'s ").items()}

    def noise_shape(self) -> tuple[int, ...]:
        return (1 + 2 * 4, 3)

    def member(self, noise: Array) -> tuple[Step, State]:
        """The step and the state of a member, for its deviates."""
        pair = self.primary, self.secondary
        m, J, attitudes, rates = member_bodies(pair, noise[1:].reshape(2, 4, 3))
        bodies = systems.rigid_bodies(m, J, potentials.maccullagh(self.G, m, J))
        d = jnp.array([self.orbit.separation_m, 0.0, 0.0])
        speed = _speed(self.orbit, bodies, d, attitudes)
        across = speed + self.orbit.speed_change_mm_s / 1000
        v = jnp.stack([0 * across, across, 0 * across]) + self.spread.velocity_mm_s / 1000 * noise[0]
        orbital = jnp.stack([0 * speed, 0 * speed, speed / d[0]])
        is_relative = jnp.array([[body.relative_to == "orbit"] for body in pair])
        rates = rates + jnp.where(is_relative, jax.vmap(so3.Ad_star, (0, None))(attitudes, orbital), 0.0)
        shares = jnp.stack([-m[1], m[0]]) / (m[0] + m[1])
        x, v = shares[:, None] * d, shares[:, None] * v
        state = bodies.state(x, attitudes, velocities=v, angular_velocities=rates)
        return self.step_by(self.scheme, bodies), state

    def step_by(self, scheme: str, bodies: RigidBodies) -> Step:
        """The step of a scheme: that of the scenario at its order, the others at their default order."""
        return step_of(bodies, scheme, self.order if scheme == self.scheme else None)

    @for_last_run
    def motion(self, run: Run) -> RelativeMotion:
        """The angles and distances of a run."""
        return measure.relative_motion(run)

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy and momenta."""
        parts, Phi = measure.pair_energies(run), series(RigidBodies.momentum, run)
        P, L = Phi[..., :3], Phi[..., 3:]
        of_secondary = length(np.asarray(run.state.p)[0, :, 1, :3])
        return [
            Conserved("energy, over |energy of the orbit|", parts.total, abs(parts.orbit[0])),
            Conserved(_ENERGY, parts.total, abs(parts.total[0])),
            Conserved("linear momentum, over that of the secondary", P, of_secondary, norm=length),
            Conserved(_MOMENTUM, L, length(L[0]), norm=length),
        ]

    def quantities(self, run: Run) -> list[Quantity]:
        """Periods, precessions and librations, with published values."""
        t, found = np.asarray(run.t), self.motion(run)
        orbit, lines = measure.apsides(found), measure.librations(found)
        inclined = found.inclination.max(axis=0) > 1e-9  # less is round-off
        precession = np.where(inclined, measure.mean_rate(t, found.node), np.nan)
        published: dict[str, Published] = {**self.published}
        table: list[tuple[str, np.ndarray, str]] = [
            ("orbital period (h)", orbit.period / HOUR, "orbital_period_h"),
            ("primary's spin period (h)", _hours(t, found.spin_1), "primary_spin_period_h"),
            ("secondary's spin period (h)", _hours(t, found.spin_2), ""),
            ("eccentricity of the mean ellipse", orbit.eccentricity, ""),
            ("precession of the line of apsides (°/d)", _DEG_D * orbit.precession_rate, "apsidal_precession_deg_d"),
            ("precession of the orbit's normal about L (°/d)", _DEG_D * precession, ""),
            ("libration of the secondary, largest (°)", np.rad2deg(_swing(found)), ""),
            ("  its line at the orbit's anomalistic frequency (°)", np.rad2deg(lines.forced), ""),
            ("  its strongest line below that (°)", np.rad2deg(lines.free), ""),
            ("  the frequency of that line, over the orbit's", orbit.period / lines.free_period, ""),
            ("line of centers from its equator, largest (°)", np.rad2deg(abs(found.out_of_plane).max(axis=0)), ""),
            ("its obliquity, largest (°)", np.rad2deg(found.obliquity.max(axis=0)), ""),
        ]
        return [Quantity(name, x, published=published.get(key)) for name, x, key in table]

    def remarks(self, run: Run) -> list[str]:
        """How periods are measured, which members stay upright, exchanges of energy, and the published impact."""
        found, days = self.motion(run), abs(run.t[-1] - run.t[0]) / DAY
        faces, upright = measure.is_librating(found.libration), np.rad2deg(found.obliquity).max(axis=0) < _UPRIGHT
        lines = [
            f"  periods and rates: mean rates of longitudes about L over {days:.4g} d, by least squares",
            f"  {faces.sum()} of {len(faces)} members: one end of the secondary's x axis stays toward the primary",
            f"  {upright.sum()} of {len(faces)} members: its z axis stays within {_UPRIGHT}° of the orbit's normal",
            *_exchange(run),
        ]
        if {"orbital_period_h", "orbital_period_before_h"} <= set(self.published):
            lines += self._impact_lines(run)
        return lines

    def impact(self, run: Run) -> Impact:
        """The change of the initial speed that changes the published period before into that after."""
        first, start = run.member(0).step, nominal_state(run)
        duration = self.dt, self.steps, self.save_every

        def measure(change: Array) -> tuple[Array, Array]:
            return orbital_period(first, start, *duration, change)

        before, after = (self.published[key].value * HOUR for key in ("orbital_period_before_h", "orbital_period_h"))  # pyright: ignore[reportArgumentType]
        ends = [speed_change_for(period, measure) for period in (before, after)]
        d = float(jnp.linalg.norm(relative_state(first.system, start)[0]))
        mu = self.G * float(jnp.sum(first.system.masses))
        unchanged = float(measure(jnp.asarray(-self.orbit.speed_change_mm_s / 1000))[0])
        middle = (before + after) / 2
        a, speed = (mu * (middle / (2 * np.pi)) ** 2) ** (1 / 3), kepler_speed(mu, d, middle)
        return Impact(
            unchanged / HOUR,
            1000 * (ends[1] - ends[0]),
            float(measure(jnp.asarray(sum(ends) / 2))[1]) / HOUR / 1000,
            1000 * (kepler_speed(mu, d, after) - kepler_speed(mu, d, before)),
            3 * a * speed / mu * middle / HOUR / 1000,
        )

    def _impact_lines(self, run: Run) -> list[str]:
        """The lines of the report on the change of the secondary's speed by the impact."""
        found, published = self.impact(run), self.published
        before, after = published["orbital_period_before_h"], published["orbital_period_h"]
        lines = [
            f"\n  published: orbital period {before.value:g} h before the impact ({self.source(before.source)}), "
            f"{after.value:g} h after",
            f"  {'period without the change of speed of this scenario':<54}{found.period_unchanged:>11.4f} h",
            f"  {'change of speed between the two published periods':<54}{found.change:>11.3f} mm/s",
            f"  {'  for two points':<54}{found.kepler:>11.3f} mm/s",
            f"  {'derivative of the period by the speed, half-way':<54}{found.slope:>11.4f} h/(mm/s)",
            f"  {'  for two points, ΔT/T = 3 a v Δv/GM':<54}{found.kepler_slope:>11.4f} h/(mm/s)",
        ]
        measured = published.get("speed_change_mm_s")
        if measured is not None:
            lines.append(f"  {'published change of speed (mm/s)':<54}     {citation(self, measured)}")
        return lines

    @picture(2, size=(5.5, 3.8))
    def draw_orbit(self, axes: np.ndarray, run: Run) -> None:
        """Plot distance and libration of the secondary: the nominal member, and 90 % of up to `_MAX_DRAWN` members."""
        given = run.step, State(run.state.q[0], run.state.p[0])
        first, start = jax.tree.map(lambda x: jnp.asarray(x)[:_MAX_DRAWN], given)
        count, every = drawn_steps(_FINE * self.steps)  # in smaller steps than those of the run
        made = runs.run(first, start, self.dt / _FINE, count, save_every=every, own_step=True, progress=False)
        days, found = np.asarray(made.t) / DAY, measure.relative_motion(made)
        swing = np.rad2deg(found.libration - np.pi * np.round(found.libration[0] / np.pi))
        panels = (found.distance, "distance (m)"), (swing, "libration of the secondary (°)")
        for ax, (x, label) in zip(axes, panels, strict=True):
            if x.shape[1] > 1:
                low, high = np.percentile(x, [5, 95], axis=1)
                ax.fill_between(days, low, high, color=plots.GRAY, lw=0, label=f"90 % of {x.shape[1]} members")
            ax.plot(days, x[:, 0], color=plots.BLUE, lw=0.8, label="nominal member")
            ax.set(xlabel="t (d)", ylabel=label)
            ax.margins(x=0.01, y=0.1)
        low, high = axes[0].get_ylim()
        axes[0].set_ylim(low, high + 0.1 * (high - low))  # room for the legend
        axes[0].legend(loc="upper right", ncols=2)

    @picture(size=(7.2, 4.2))
    def draw_spectrum(self, axes: np.ndarray, run: Run) -> None:
        """Plot the spectrum of the nominal secondary's libration over a longer run, and its expected frequencies."""
        one, ax = run.member(0), axes[0]
        long = as_batch(self.drawn(one, steps=_LONG * self.steps))
        t, found = np.asarray(long.t), measure.relative_motion(long)
        f, amplitude = measure.spectrum(t, np.rad2deg(found.libration[:, 0]))
        orbital = float(mean_rate(t, found.longitude)[0]) / (2 * np.pi)
        A, B, C = (float(x) for x in one.system.inertias[1])  # pyright: ignore[reportAttributeAccessIssue]
        anomalistic = 1 / float(measure.apsides(found).anomalistic_period[0])
        shown = (f > 0) & (f < 3 * orbital)
        ax.semilogy(f[shown] / orbital, amplitude[shown], color=plots.INK, lw=0.7)
        marks = {"once an orbit, from apsis to apsis": anomalistic / orbital}
        if B > A:
            marks["free libration of a small swing, √(3(B−A)/C)"] = np.sqrt(3 * (B - A) / C)
        for (label, x), style in zip(marks.items(), plots.STYLES[1:], strict=False):
            ax.axvline(x, color=style["color"], ls="--", lw=0.9, label=label)
        ax.set(xlim=(0, 3), xlabel="frequency over that of the orbit", ylabel="amplitude of the libration (°)")
        ax.legend(loc="upper right")
        ax.set_title(f"nominal member, {abs(t[-1] - t[0]) / DAY:.4g} d")

    @picture(2, size=(5.5, 3.8))
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot the exchange of energy between orbit, spins and shapes, and how well two schemes conserve H and L."""
        left, right = axes
        one = run.member(0)
        orbital_period = float(measure.apsides(self.motion(run)).period[0])
        steps = min(self.steps, round(_BRIEF * orbital_period / abs(self.dt)))
        brief = self.drawn(one, _FINE, steps)  # the primary rotates once in few steps
        parts = measure.pair_energies(brief)
        size, names = abs(parts.orbit[0]), _PARTS | {"orbit": "orbit", "shape": "shapes, V + Gm₁m₂/r"}
        curves = {names[key]: (x - x[0]) / size for key, x in parts._asdict().items() if key in names}
        plots.series(left, np.asarray(brief.t) / DAY, curves, "change over |energy of the orbit|", "d")
        left.margins(y=0.25)
        left.legend(loc="upper center", ncols=2)
        left.set_title(f"exchange of energy, nominal member, {_BRIEF} orbits")
        compared = dict.fromkeys((self.scheme, "kepler_splitting", "bodies_energy_momentum"))
        both = [self.step_by(name, one.system) for name in compared]  # pyright: ignore[reportArgumentType]
        draw_errors(right, self, one, both, _SHOWN, "relative change", DAY, "d")
        right.set_ylim(top=1e3 * right.get_ylim()[1])  # room for the legend
        right.legend(loc="upper center", ncols=2)
        right.set_title("energy H and angular momentum L")


def _speed(orbit: Orbit, bodies: RigidBodies, d: Array, attitudes: Array) -> Array:
    """The relative speed before its change: the given one, or that of a circle under the force along the line."""
    if orbit.speed_m_s is not None:
        return jnp.asarray(orbit.speed_m_s)
    m, origin = bodies.masses, jnp.zeros(3)
    places = jnp.stack([jnp.concatenate([x, q]) for x, q in zip((origin, d), attitudes, strict=True)])
    return jnp.sqrt(-bodies.force(places)[1, 0] * (m[0] + m[1]) / (m[0] * m[1]) * d[0])


def _hours(t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The mean period of an angle."""
    return 2 * np.pi / np.asarray(mean_rate(t, angle)) / HOUR


def _swing(motion: RelativeMotion) -> np.ndarray:
    """The largest libration of each member about the multiple of π nearest to its start."""
    center = np.pi * np.round(motion.libration[0] / np.pi)
    return abs(motion.libration - center).max(axis=0)


def _exchange(run: Run) -> list[str]:
    """The range of each part of the energy, greatest less least."""
    parts = measure.pair_energies(run)
    size = abs(parts.orbit[0, 0])
    heads = f"{'nominal':>11}{'± ensemble':>12}   over |orbit's energy|"
    lines = [f"\n  {'energy exchanged, greatest − least (J)':<54}{heads}"]
    for key, name in _PARTS.items():
        swing = np.ptp(parts._asdict()[key], axis=0)
        spread = float(standard_deviation(swing))
        lines.append(f"  {name:<54}{swing[0]:>11.3g}{spread:>12.2g}   {swing[0] / size:.3g}")
    return lines


class Impact(NamedTuple):
    """The change of speed that follows from the published change of the period; periods in h, speeds in mm/s."""

    period_unchanged: float  # the period of the nominal state without the scenario's change of speed
    change: float  # the change of speed from the published period before to that after, by the whole model
    slope: float  # the derivative of the period by the speed half-way, h/(mm/s)
    kepler: float  # the change of speed for two points
    kepler_slope: float  # the derivative for two points, h/(mm/s)


_MAX_ITERATIONS = 8  # of Newton's method for the speed
_TOLERANCE = 1e-5  # largest last correction over the change; the error that Newton's method leaves is its square


def relative_state(system: RigidBodies, state: State) -> tuple[Array, Array]:
    """The relative position d and the relative velocity v."""
    x, v = state.q[:, :3], state.p[:, :3] / system.masses[:, None]
    return x[1] - x[0], v[1] - v[0]


def with_speed_change(system: RigidBodies, state: State, change: Array) -> State:
    """The state with `change` added to the speed of the relative motion, across the line of centers."""
    m, (d, v) = system.masses, relative_state(system, state)
    across = v - d * (vectors.dot(d, v) / vectors.dot(d, d))
    push = m[0] * m[1] / (m[0] + m[1]) * change * across / vectors.norm(across)
    return state._replace(p=state.p.at[:, :3].add(jnp.stack([-push, push])))


@partial(jax.jit, static_argnames=("num_steps", "save_every"))
def orbital_period(
    step: Step, state: State, dt: float, num_steps: int, save_every: int, change: Array
) -> tuple[Array, Array]:
    """The orbital period after a change of the initial speed, and its derivative by that change.

    The derivative is that of the whole model, by a tangent vector along the run, not of Kepler's formula.
    """

    def period_after(change: Array) -> Array:
        system: Any = step.system
        run = integrate(step, with_speed_change(system, state, change), dt, num_steps, save_every=save_every)
        L = system.momentum(state)[3:]
        up = L / vectors.norm(L)
        e1, e2 = frame(up)

        def longitude(state: State) -> Array:
            d, _ = relative_state(system, state)
            return jnp.arctan2(vectors.dot(e2, d), vectors.dot(e1, d))

        angles = jax.vmap(longitude)(run.state)
        return jnp.asarray(2 * jnp.pi / mean_rate(run.t, jnp.unwrap(angles)))

    return jax.jvp(period_after, (change,), (jnp.ones_like(change),))


def speed_change_for(target: float, measure: Callable[[Array], tuple[Array, Array]]) -> float:
    """The change of speed that gives the orbital period `target`, by Newton's method; nan if it fails to converge.

    `measure` returns the period and its derivative for a change of speed, as `orbital_period` does.
    """
    change = 0.0
    for _ in range(_MAX_ITERATIONS):
        found, slope = measure(jnp.asarray(change))
        correction = (target - float(found)) / float(slope)
        change += correction
        if abs(correction) <= _TOLERANCE * abs(change):
            return change
    return float("nan")


def kepler_speed(mu: float, r: float, period: float) -> float:
    """The speed at the distance r, an apsis, of an orbit of two points with this period."""
    a = (mu * (period / (2 * np.pi)) ** 2) ** (1 / 3)
    return float(np.sqrt(mu * (2 / r - 1 / a)))
