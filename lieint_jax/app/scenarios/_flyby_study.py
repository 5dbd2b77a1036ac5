"""What a flyby shows: its members, further passages (a map of phases, other arcs, other assumptions), the report."""

from __future__ import annotations

import textwrap
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke

from lieint_jax import plots
from lieint_jax.app.scenarios import _flyby_motion as motion
from lieint_jax.app.scenarios._body import longitude_latitude
from lieint_jax.app.scenarios._flyby_motion import Outcome, Passage, Spin
from lieint_jax.app.scenarios._keys import HOUR
from lieint_jax.app.scenarios._kind import for_last_run, picture
from lieint_jax.app.scenarios._pictures import draw_histogram
from lieint_jax.app.scenarios._report import Quantity, paragraphs, table_lines
from lieint_jax.app.scenarios._runs import angles
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.types import State

Flyby: TypeAlias = Any  # the scenario, whose module imports this one
_SLOPE_ORDER = 4  # of the differentiated steps: the errors of derivatives are below 5e-4 of the largest
_QUANTILES = (0.05, 0.5, 0.95)
_LONGEST = 500.0  # h of P_ψ, which is infinite between the modes: the last color shows all larger values
_MARGIN = 10.0  # ° from the edge of a map, where the axis would cross a label of a contour
_CHECKED = 256  # members that are integrated again in shorter steps and over other arcs


class Study(NamedTuple):
    """The contents of the report and the pictures."""

    run: Passage  # the passages of the members of the run
    grid: Spin  # the spins of the map, φ slowest
    mapped: Passage  # the passages of the map
    # derivatives at every second value of both phases, by name, as `_flyby_motion.slopes` returns them
    slopes: dict[str, np.ndarray]
    step_error: float  # the largest angle between final attitudes by the steps of the run and by steps half as long
    arcs: dict[float, Passage]  # passages of the first members, by the length of the arc in h
    variants: dict[str, Passage]  # passages under other assumptions, by their labels
    failed: int  # the number of these passages with a step that did not converge


@for_last_run
def study(scenario: Flyby, run: Run) -> Study:
    """The study of a run: its members before and after the passage, and the further passages of the report."""
    from tqdm import tqdm

    system: Any = run.system
    outcomes, J = jax.jit(jax.vmap(motion.outcome)), system.inertia
    ends = [jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), run.state) for k in (0, -1)]
    before, after = (jax.tree.map(np.asarray, outcomes(J, State(z.q, z.p))) for z in ends)
    own = Passage(before, after, ends[1].q, jnp.asarray(run.info.converged).all(axis=0))
    grid, first = phases(scenario), _first_members(scenario, _CHECKED)
    orbit, long_axis = scenario.orbit.elements(), scenario.spin.long_axis
    passages, slopes = motion.passages(scenario.order, long_axis), motion.slopes(_SLOPE_ORDER, long_axis)
    count = 3 + len(scenario.arcs_hours) + len(scenario.variant)
    with tqdm(total=count, unit=" passages", disable=None, leave=False) as bar:

        def counted(function: Any, spins: Spin, *times: Any) -> Any:
            made = function(spins, orbit, scenario.times(*times))
            bar.update()
            return made

        mapped = counted(passages, grid)
        fine = counted(passages, first, None, 2 * scenario.steps)
        arcs = {hours: counted(passages, first, hours, 2 * scenario.steps) for hours in scenario.arcs_hours}
        variants = {}
        for variant in scenario.variant:
            variants[variant.label] = _passages_of_variant(scenario, variant, len(grid.phi))
            bar.update()
        by_unknown = counted(slopes, scenario.every_second_phase(grid))
    count = min(_CHECKED, len(own.q))
    step_error = float(np.max(_angles(fine.q[:count], own.q[:count])))
    failed = sum(int((~x.converged).sum()) for x in (mapped, fine, *arcs.values(), *variants.values()))
    return Study(own, grid, mapped, by_unknown, step_error, arcs, variants, failed)


_angles = jax.jit(jax.vmap(so3.angle))


def phases(scenario: Flyby) -> Spin:
    """The nominal spin at the phases of the map, φ slowest."""
    given = [x.value for x in scenario.spin.measured().values()]
    n, m = scenario.map.precession_phases, scenario.map.rotation_phases
    phi, psi = np.meshgrid(2 * np.pi * np.arange(n) / n, np.pi * np.arange(m) / m, indexing="ij")
    same = [np.full(phi.size, x) for x in (*given[:4], *np.deg2rad(given[4:]))]
    return Spin(*map(jnp.asarray, (*same, phi.ravel(), psi.ravel())))


def _first_members(scenario: Flyby, count: int) -> Spin:
    """The first `count` members, drawn by the compiled program that draws all members of the run."""
    at_least = scenario.model_copy(update={"members": max(count, scenario.members)})
    return jax.tree.map(lambda x: x[:count], motion.members(at_least)[0])


def _passages_of_variant(scenario: Flyby, variant: Any, count: int) -> Passage:
    """The passages of `count` members under the assumptions of a variant."""
    spin = scenario.spin.with_changes(variant)
    orbit = scenario.orbit.model_copy(update={"frame": variant.frame or scenario.orbit.frame})
    spins = _first_members(scenario.model_copy(update={"spin": spin}), count)
    return motion.passages(scenario.order, spin.long_axis)(spins, orbit.elements(), scenario.times())


class Unknown(NamedTuple):
    """What the passage depends on."""

    change: str  # a change of it, for the report
    size: float  # the size of that change
    name: str  # for the picture
    sigma: float  # one standard deviation; 0 if it is known


def unknowns(scenario: Flyby) -> dict[str, Unknown]:
    """The unknowns by the names of `Study.slopes`."""
    given, degree = scenario.spin, np.deg2rad(1.0)
    sigma = {name: sum(x.sides()) / 2 / scenario.sigmas for name, x in given.measured().items()}
    east = sigma["momentum_longitude_deg"] / np.cos(np.deg2rad(given.momentum_latitude_deg.value))
    north, phase = np.deg2rad(sigma["momentum_latitude_deg"]), np.pi / np.sqrt(3)
    return {
        "phi": Unknown("1° of φ", degree, "$\\phi$, uniform", phase),
        "psi": Unknown("1° of ψ", degree, "$\\psi$, uniform", phase),
        "least": Unknown("0.01 of I₁/I₃", 0.01, "moment $I_1/I_3$", sigma["least_moment"]),
        "middle": Unknown("0.001 of I₂/I₃", 0.001, "moment $I_2/I_3$", sigma["middle_moment"]),
        "precession": Unknown("0.01 h of P_φ before", 0.01, "$P_\\phi$ before", sigma["precession_period_h"]),
        "rotation": Unknown("1 h of P_ψ before", 1.0, "$P_\\psi$ before", sigma["rotation_period_h"]),
        "longitude": Unknown("1° of the pole's longitude", degree, "pole's longitude", np.deg2rad(east)),
        "latitude": Unknown("1° of the pole's latitude", degree, "pole's latitude", north),
        "perigee": Unknown("1 km of the perigee", 1.0, "perigee", 0.0),
    }


def report(scenario: Flyby, run: Run) -> str:
    """The passage, periods, spin rates and poles before and after with published ones, sensitivities and errors."""
    found = study(scenario, run)
    lines = [
        *_published_lines(scenario, found),
        *_change_lines(found),
        *_expectations(scenario, found),
        *_by_phase(scenario, found),
        *_sensitivity(scenario, found),
        *_errors(scenario, found),
        *_variants(found),
        *paragraphs(scenario.notes),
        f"\n  {found.failed} of these passages had a step that did not converge",
    ]
    return "\n".join(line.rstrip() for line in lines)


def facts(scenario: Flyby, before: Outcome) -> list[Quantity]:
    """Quantities of the orbit and of the members before the passage, with published values."""
    position, velocity = (np.asarray(x) for x in motion.GivenOrbit(scenario.orbit.elements())(jnp.zeros(())))
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


def _published_lines(scenario: Flyby, found: Study) -> list[str]:
    date, hours = scenario.orbit.date, scenario.hours
    redrawn = 1 - motion.members(scenario)[1].mean()
    return [
        f"\n  from {date(-hours):%Y-%m-%d %H:%M} to {date(hours):%Y-%m-%d %H:%M} UTC; "
        f"perigee {date(0):%Y-%m-%d %H:%M:%S} UTC",
        f"  {100 * redrawn:.3g} % of the moments were drawn again: no {scenario.spin.mode} mode has such periods",
        *table_lines(scenario, facts(scenario, found.run.before), 52, "before"),
    ]


def _row(name: str, x: np.ndarray, form: str = "9.3f") -> str:
    found = [*np.quantile(x, _QUANTILES), x.min(), x.max()] if x.size else [np.nan] * 5
    return f"  {name:<52}" + "".join(f"{value:>{form}}" for value in found)


def _change_lines(found: Study) -> list[str]:
    changed, after = found.run.change, found.run.after
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


def _expectations(scenario: Flyby, found: Study) -> list[str]:
    x = found.run.change
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


def _by_phase(scenario: Flyby, found: Study) -> list[str]:
    x, after = found.mapped.change, found.mapped.after
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


def _sensitivity(scenario: Flyby, found: Study) -> list[str]:
    lines = [
        "\n  sensitivities over the map, by forward differentiation of the whole passage: median and largest",
        f"  {'by':<28}{'dP_φ (h)':>18}{'dP_ψ (h)':>22}{'d ln(spin rate)':>22}{'d pole (°)':>20}",
    ]
    rate = scenario.every_second_phase(found.mapped.after.rate)
    for name, unknown in unknowns(scenario).items():
        x = abs(found.slopes[name]) * unknown.size
        scaled = (x[:, 0], x[:, 1], x[:, 2] / rate, np.rad2deg(x[:, 3]))
        lines.append(f"  {unknown.change:<28}" + "".join(f"{np.median(v):>11.3g} {v.max():>9.3g}" for v in scaled))
    return lines


def _errors(scenario: Flyby, found: Study) -> list[str]:
    longest = max(found.arcs)
    best = found.arcs[longest].after
    heads = ("P_φ (h)", "P_ψ (%)", "2H/|L| (%)", "pole (°)")
    lines = [
        f"\n  attitude at the end, {scenario.steps} steps and twice as many: {found.step_error:.1e} rad, largest of "
        f"{min(_CHECKED, len(found.run.q))} members",
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


def _variants(found: Study) -> list[str]:
    heads = {"P_φ (h)": 22, "spin rate": 20, "pole rotated (°)": 22, "same mode": 11}
    title = "other assumptions: 5 %, median, 95 %"
    lines = [f"\n  {title:<42}" + "".join(f"{head:>{width}}" for head, width in heads.items())]
    for name, passage in ({"the run": found.run} | found.variants).items():
        x, after = passage.change, passage.after
        columns = [(after.precession, 22, ".1f"), (x.rate, 20, ".2f"), (x.pole_angle, 22, ".1f")]
        text = "".join(
            f"{', '.join(format(v, form) for v in np.quantile(values, _QUANTILES)):>{width}}"
            for values, width, form in columns
        )
        lines.append(f"  {name:<42}{text}{100 * np.mean(x.same_mode):>9.1f} %")
    return lines


@picture(2, 2)
def draw_map(scenario: Flyby, axes: np.ndarray, run: Run) -> None:
    """Plot periods, effective spin rate and rotation of the pole after the passage, over both phases at the perigee."""
    found = study(scenario, run)
    x, after = found.mapped.change, found.mapped.after
    shape = (scenario.map.precession_phases, scenario.map.rotation_phases)
    P_phi, P_psi = found.mapped.before.precession[0], found.mapped.before.rotation[0]
    contours, shown = (18, 20, 24, 28, 32, 36, 40), np.clip(after.rotation, None, _LONGEST)
    panels = (
        ("effective spin rate $2H/|L|$ over that before", x.rate, "PuOr_r", (0.5, 0.75, 1, 1.25, 1.5, 2), True),
        (f"precession period $P_\\phi$ (h); before {P_phi:.2f}", after.precession, "viridis", contours, False),
        (f"rotation period $P_\\psi$ (h); before {P_psi:.0f}", shown, "cividis", (), False),
        ("rotation of the pole (°)", x.pole_angle, "magma", (5, 10, 15, 20, 25, 30), False),
    )
    for ax, (title, values, colors, levels, is_ratio) in zip(axes, panels, strict=True):
        maps = values.reshape(shape), after.long_axis.reshape(shape)
        _draw_phases(ax, *maps, scenario.spin.same_passage_deg, colors, levels, is_ratio)
        ax.set_title(title)
    for ax in axes[2:]:
        ax.set_xlabel("precession phase $\\phi$ at the perigee (°)")
    for ax in axes[::2]:
        ax.set_ylabel("rotation phase $\\psi$ at the perigee (°)")
    axes[0].figure.suptitle(f"{scenario.title}: nominal body, every phase; hatched: a long-axis mode after the passage")


def _draw_phases(ax: Any, values: Any, long_axis: Any, same_deg: int, colors: str, levels: Any, is_ratio: bool) -> None:
    """Plot a map over φ and ψ, both to 360°: its second half is the first, with ψ + 180° and φ + `same_deg`."""
    n, m = values.shape

    def full_circle(x: np.ndarray) -> np.ndarray:
        full = np.concatenate([x, np.roll(x, n * same_deg // 360, axis=0)], axis=1)
        return np.pad(full, ((0, 1), (0, 1)), mode="wrap").T

    phi, psi = np.linspace(0, 360, n + 1), np.linspace(0, 360, 2 * m + 1)
    options: dict[str, Any] = {"cmap": colors, "shading": "gouraud", "rasterized": True}
    if is_ratio:
        most = max(abs(np.log(values)).max(), np.log(1.2))
        options["norm"] = LogNorm(np.exp(-most), np.exp(most))
    image = ax.pcolormesh(phi, psi, full_circle(values), **options)
    bar = ax.figure.colorbar(image, ax=ax, extend="max" if values.max() == _LONGEST else "neither")
    shown = [level for level in levels if values.min() < level < values.max()]
    if is_ratio:
        bar.set_ticks(shown, labels=[f"{level:g}" for level in shown])
        bar.ax.minorticks_off()
    if shown:
        lines = ax.contour(phi, psi, full_circle(values), shown, colors=plots.INK, linewidths=0.6)
        outline = [withStroke(linewidth=2, foreground="white")]
        for text in ax.clabel(lines, fontsize="x-small", fmt="%g"):
            text.set_path_effects(outline)
            text.set_visible(all(_MARGIN < x < 360 - _MARGIN for x in text.get_position()))
    if long_axis.any():
        mode = full_circle(long_axis.astype(float))
        hatched = ax.contourf(phi, psi, mode, [0.5, 1.5], hatches=["///"], colors="none")
        hatched.set(edgecolor="white", linewidth=0)
        ax.contour(phi, psi, mode, [0.5], colors="white", linewidths=1.4)
    ax.set_xticks(range(0, 361, 90))
    ax.set_yticks(range(0, 361, 90))


@picture(3, 2)
def draw_after(scenario: Flyby, axes: np.ndarray, run: Run) -> None:
    """Plot the members after the passage: distributions of periods, spin rate and rotation of the pole, and poles."""
    found = study(scenario, run)
    x, after, before = found.run.change, found.run.after, found.run.before
    panels = (
        ("precession period $P_\\phi$ (h)", after.precession, before.precession[0]),
        ("rotation period $P_\\psi$ (h)", after.rotation, before.rotation[0]),
        ("$|L|$ over that before", x.momentum, 1.0),
        ("effective spin rate $2H/|L|$ over that before", x.rate, 1.0),
        ("rotation of the pole (°)", x.pole_angle, None),
    )
    for ax, (label, values, initial) in zip(axes, panels, strict=False):
        parts = {"short-axis mode": values[~after.long_axis], "long-axis mode": values[after.long_axis]}
        draw_histogram(ax, parts, label, {} if initial is None else {"before (nominal)": initial}, shown=0.99)
    for ax in axes[1:5]:
        ax.get_legend().remove()
    fig = axes[0].figure
    axes[5].remove()
    _draw_poles(fig.add_subplot(2, 3, 6, projection="polar"), before, after)
    count = f"{len(after.rate):,}".replace(",", "\u202f")
    rest = "the highest 1 % of each histogram not shown"
    fig.suptitle(f"{scenario.title}: {count} members, uniform phases; {rest}")


def _draw_poles(ax: Any, before: Outcome, after: Outcome) -> None:
    """Plot the poles on the sky about the nearer pole of the ecliptic."""
    side = np.sign(before.pole[0, 2]) or 1.0
    for outcome, color, label in ((before, plots.GREEN, "before"), (after, plots.WINE, "after")):
        longitude, latitude = np.asarray(longitude_latitude(outcome.pole)).T
        size = np.clip(4000 / len(longitude), 1.0, 10.0)
        ax.scatter(np.deg2rad(longitude), 90 - side * latitude, s=size, lw=0, color=color, alpha=0.35, rasterized=True)
        ax.plot([], [], "o", ms=4, color=color, label=label)
    far = 90 - side * np.asarray(longitude_latitude(np.concatenate([before.pole, after.pole])))[:, 1]
    ax.set_rlim(0, 10 * np.ceil(np.quantile(far, 0.999) / 10))
    ax.set_rlabel_position(22.5)
    ax.tick_params(labelsize="x-small")
    pole = "north" if side > 0 else "south"
    ax.set_xlabel(f"direction of $L$: longitude, and ° from the {pole} pole of the ecliptic", labelpad=8)
    ax.legend(loc="upper left", bbox_to_anchor=(-0.3, 1.1))


@picture(2)
def draw_sensitivity(scenario: Flyby, axes: np.ndarray, run: Run) -> None:
    """Plot the change of the periods by one standard deviation of each unknown, to first order, over the phases."""
    found = study(scenario, run)
    shown = {key: x for key, x in unknowns(scenario).items() if x.sigma > 0}
    look: dict[str, Any] = {"orientation": "horizontal", "whis": (5, 95), "showfliers": False}
    look |= {"medianprops": {"color": plots.RED}, "tick_labels": [x.name for x in shown.values()]}
    for k, (ax, period) in enumerate(zip(axes, ("$P_\\phi$", "$P_\\psi$"), strict=True)):
        changes = [abs(found.slopes[key][:, k]) * x.sigma for key, x in shown.items()]
        ax.boxplot([x[x > 0] for x in changes], **look)  # a logarithmic axis has no zero
        ax.invert_yaxis()
        ax.set(xscale="log", xlabel=f"change of {period} after the passage (h)")
    axes[1].set_yticklabels([])
    axes[0].figure.suptitle(
        f"{scenario.title}: effect of one standard deviation of each unknown\n"
        "to first order, over all phases: median, quartiles, 5 % and 95 %"
    )
