"""A tumbling body passes a planet: periods, mode, spin rate and pole before and after, over all phases.

The clock is the time since the perigee, in h; lengths are in km. The members share the orbit; each has its own moments,
periods and pole, drawn from the published errors, and two uniform phases (see `_flyby_motion`): the leaves of the step
have the member axis.
"""

from __future__ import annotations

import textwrap
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.app.scenarios import _flyby_motion as motion
from lieint_jax.app.scenarios._flyby_keys import FlybyKeys
from lieint_jax.app.scenarios._flyby_motion import GivenOrbit, Outcome
from lieint_jax.app.scenarios._flyby_pictures import draw_after, draw_map, draw_sensitivity
from lieint_jax.app.scenarios._flyby_study import CHECKED, Study, change_of_spin, members, study, unknowns
from lieint_jax.app.scenarios._keys import HOUR
from lieint_jax.app.scenarios._report import Quantity, paragraphs, table_lines
from lieint_jax.app.scenarios._runs import angles
from lieint_jax.runs import Run
from lieint_jax.types import State, Step

_QUANTILES = (0.05, 0.5, 0.95)


class Flyby(FlybyKeys):
    """The keys of a scenario of this kind."""

    own_step = True  # every member has its own body
    draw_map, draw_after, draw_sensitivity = draw_map, draw_after, draw_sensitivity

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The step, whose leaves have the member axis, and the states at the start, which share their time."""
        orbit, t = GivenOrbit(self.orbit.elements()), jnp.asarray(-self.hours)
        made = partial(motion.step_and_state, orbit=orbit, t=t, order=self.order, long_axis=self.spin.long_axis)
        step, states = jax.jit(jax.vmap(made))(members(self)[0])
        return step, states._replace(t=t)

    def report(self, run: Run) -> str:
        """The passage, periods, spin rates and poles before and after with published ones, sensitivities and errors."""
        found = study(self, run)
        lines = [
            *_published_lines(self, found),
            *_change_lines(self, found),
            *_expectations(self, found),
            *_by_phase(self, found),
            *_sensitivity(self, found),
            *_errors(self, found),
            *_variants(self, found),
            *paragraphs(self.notes),
            f"\n  {found.failed} of these passages had a step that did not converge",
        ]
        return "\n".join(line.rstrip() for line in lines)


def facts(scenario: FlybyKeys, before: Outcome) -> list[Quantity]:
    """Quantities of the orbit and of the members before the passage, with published values."""
    position, velocity = (np.asarray(x) for x in GivenOrbit(scenario.orbit.elements())(jnp.zeros(())))
    date, a = scenario.orbit.date(0), scenario.orbit.elements()[1]
    at_infinity = float(np.sqrt(-scenario.orbit.gm_km3_s2 / a))
    light = 1 / (1 / before.precession - 1 / before.rotation)
    hours = date.hour + date.minute / 60 + date.second / HOUR

    def quantity(name: str, values: np.ndarray | float, key: str = "") -> Quantity:
        published = [known for known in scenario.published if known.quantity == key]
        return Quantity(name, np.atleast_1d(values), published=published)

    return [
        quantity("distance at the perigee (km)", float(np.linalg.norm(position)), "perigee_distance_km"),
        quantity("speed at the perigee (km/s)", float(np.linalg.norm(velocity)) / HOUR),
        quantity("speed far away (km/s)", at_infinity),
        quantity("time of the perigee (h, UTC)", hours, "perigee_time_utc_h"),
        quantity("precession period P_φ (h)", before.precession, "precession_period_h"),
        quantity("rotation period P_ψ (h)", before.rotation, "rotation_period_h"),
        quantity("1/(1/P_φ − 1/P_ψ), strongest in light curves (h)", light, "lightcurve_period_h"),
        quantity("energy over the least at this |L|", before.excitation, "energy_ratio"),
    ]


def _published_lines(scenario: FlybyKeys, found: Study) -> list[str]:
    date, hours = scenario.orbit.date, scenario.hours
    redrawn = 1 - members(scenario)[1].mean()
    return [
        f"\n  from {date(-hours):%Y-%m-%d %H:%M} to {date(hours):%Y-%m-%d %H:%M} UTC; "
        f"perigee {date(0):%Y-%m-%d %H:%M:%S} UTC",
        f"  {100 * redrawn:.3g} % of the moments were drawn again: no {scenario.spin.mode} mode has such periods",
        *table_lines(scenario, facts(scenario, found.before), 52, "before"),
    ]


def _row(name: str, x: np.ndarray, form: str = "9.3f") -> str:
    found = [*np.quantile(x, _QUANTILES), x.min(), x.max()] if x.size else [np.nan] * 5
    return f"  {name:<52}" + "".join(f"{value:>{form}}" for value in found)


def _change_lines(scenario: FlybyKeys, found: Study) -> list[str]:
    changed, after = change_of_spin(found.before, found.after), found.after
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
        _row("rotation of the pole (°)", changed.pole_angle),
        _row("pole's longitude changed by (°)", changed.longitude, "9.1f"),
        _row("pole's distance from the ecliptic changed by (°)", changed.latitude, "9.2f"),
        f"  {100 * short.mean():.1f} % end in a short-axis mode, {100 * (~short).mean():.1f} % in a long-axis mode",
    ]


def _expectations(scenario: FlybyKeys, found: Study) -> list[str]:
    x = change_of_spin(found.before, found.after)
    share = lambda condition: f"{100 * np.mean(condition):.3g} %"  # noqa: E731
    low, high = np.quantile(x.rate, (0.05, 0.95))
    ours = {
        "rate": f"× {low:.2f} to × {high:.2f} (5 to 95 %), × {x.rate.min():.2f} to × {x.rate.max():.2f} in all; "
        f"halved or less in {share(x.rate <= 0.5)}, doubled or more in {share(x.rate >= 2)}",
        "pole_angle": f"median {np.median(x.pole_angle):.1f}°; 10° or more in {share(x.pole_angle >= 10)}",
        "longitude": f"it increases in {share(x.longitude > 0)}",
        "latitude": f"it moves closer in {share(x.latitude < 0)}",
        "mode": f"the same in {share(x.same_mode)}",
    }
    lines = ["\n  published expectations, and the members of the run"] if scenario.expected else []
    for expected in scenario.expected:
        lines += [f"  {expected.claim}  ({scenario.source(expected.source)})"]
        lines += textwrap.wrap(ours[expected.quantity], 116, initial_indent="    here: ", subsequent_indent="    ")
    return lines


def _by_phase(scenario: FlybyKeys, found: Study) -> list[str]:
    x, after = change_of_spin(found.mapped.before, found.mapped.after), found.mapped.after
    phi, psi = (np.rad2deg(np.asarray(x)) for x in (found.grid.phi, found.grid.psi))
    shift = scenario.spin.same_passage_deg
    same = "φ + 180°, ψ + 180°" if shift else "φ, ψ + 180°"
    lines = [f"\n  {f'nominal body, {len(phi)} pairs of phases':<52}{'value':>9}   at φ, ψ and at {same} (°)"]
    for name, values in (
        ("P_φ after (h)", after.precession),
        ("effective spin rate over that before", x.rate),
        ("rotation of the pole (°)", x.pole_angle),
    ):
        for which, k in (("least", values.argmin()), ("most", values.argmax())):
            lines.append(f"  {f'{name}, {which}':<52}{values[k]:>9.3f}   {phi[k]:.0f}, {psi[k]:.0f}")
    for name, holds in (
        ("spin rate halved or less", x.rate <= 0.5),
        ("spin rate below × 0.75", x.rate <= 0.75),
        ("spin rate above × 1.5", x.rate >= 1.5),
        ("spin rate doubled or more", x.rate >= 2),
        ("long-axis mode after", after.long_axis),
    ):
        modulo = 180 if shift else 360
        where = f"φ mod {modulo}° within {_interval(phi[holds], modulo)}" if holds.any() else "at no phase"
        lines.append(f"  {name:<52}{100 * holds.mean():>7.1f} %   {where}")
    return lines


def _interval(phi: np.ndarray, modulo: int) -> str:
    """The shortest interval that contains all of these angles, in degrees modulo 180° or 360°."""
    x = np.unique(np.round(phi % modulo, 9))
    gaps = np.diff(np.append(x, x[0] + modulo))
    k = int(gaps.argmax())
    first, last = x[(k + 1) % len(x)], x[k]
    return f"{first if last >= first else first - modulo:.0f}° to {last:.0f}°"


def _sensitivity(scenario: FlybyKeys, found: Study) -> list[str]:
    lines = [
        "\n  sensitivities over the map, by forward differentiation of the whole passage: median and largest",
        f"  {'by':<28}{'dP_φ (h)':>18}{'dP_ψ (h)':>22}{'d ln(spin rate)':>22}{'d pole (°)':>20}",
    ]
    rate = scenario.every_second_phase(found.mapped.after.rate)
    for name, (unit, size, _) in unknowns(scenario).items():
        x = abs(found.slopes[name]) * size
        scaled = (x[:, 0], x[:, 1], x[:, 2] / rate, np.rad2deg(x[:, 3]))
        lines.append(f"  {unit:<28}" + "".join(f"{np.median(v):>11.3g} {v.max():>9.3g}" for v in scaled))
    return lines


def _errors(scenario: FlybyKeys, found: Study) -> list[str]:
    longest = max(found.arcs)
    best = found.arcs[longest].after
    heads = ("P_φ (h)", "P_ψ (%)", "2H/|L| (%)", "pole (°)")
    lines = [
        f"\n  attitude at the end, {scenario.steps} steps and twice as many: {found.step_error:.1e} rad, largest of "
        f"{min(CHECKED, len(found.before.rate))} members",
        f"\n  {f'arcs against ± {longest:g} h, {len(best.rate)} members':<34}" + "".join(f"{x:>20}" for x in heads),
        f"  {'':<34}" + f"{'median':>11}{'largest':>9}" * 4,
    ]
    for hours, passage in found.arcs.items():
        if hours == longest:
            continue
        x = passage.after
        parts = (
            abs(x.precession - best.precession),
            100 * abs(x.rotation / best.rotation - 1),
            100 * abs(x.rate / best.rate - 1),
            np.rad2deg(angles(x.pole, best.pole)),
        )
        lines.append(f"  {f'± {hours:g} h':<34}" + "".join(f"{np.median(v):>11.2g}{v.max():>9.2g}" for v in parts))
    return lines


def _variants(scenario: FlybyKeys, found: Study) -> list[str]:
    heads = {"P_φ (h)": 22, "spin rate": 20, "pole rotated (°)": 22, "same mode": 11}
    title = "other assumptions: 5 %, median, 95 %"
    lines = [f"\n  {title:<42}" + "".join(f"{head:>{width}}" for head, width in heads.items())]
    cases = {"the run": (found.before, found.after)}
    cases |= {name: (passage.before, passage.after) for name, passage in found.variants.items()}
    for name, (before, after) in cases.items():
        x = change_of_spin(before, after)
        columns = [(after.precession, 22, ".1f"), (x.rate, 20, ".2f"), (x.pole_angle, 22, ".1f")]
        text = "".join(
            f"{', '.join(format(v, form) for v in np.quantile(values, _QUANTILES)):>{width}}"
            for values, width, form in columns
        )
        lines.append(f"  {name:<42}{text}{100 * np.mean(x.same_mode):>9.1f} %")
    return lines
