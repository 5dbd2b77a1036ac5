"""The members of a flyby, further passages (a map of phases, other arcs, other assumptions), and their pictures."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke

from lieint_jax import _free_body
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _flyby_motion as motion
from lieint_jax.app.scenarios._body import direction, longitude_latitude
from lieint_jax.app.scenarios._flyby_motion import Outcome, Passage, Spin
from lieint_jax.app.scenarios._kind import for_last_run, picture
from lieint_jax.app.scenarios._runs import angles
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.types import State, vectors

Flyby: TypeAlias = Any  # the scenario, whose module imports this one
_TRIES = 16  # draws of a member's moments; the first for which the mode exists is used
_SLOPE_ORDER = 4  # of the differentiated steps: the errors of derivatives are below 5e-4 of the largest
_LONGEST = 500.0  # h of P_ψ, which is infinite between the modes: the last color shows all larger values
_MARGIN = 10.0  # ° from the edge of a map, where the axis would cross a label of a contour
CHECKED = 256  # members that are integrated again in shorter steps and over other arcs


def members(scenario: Flyby) -> tuple[Spin, np.ndarray]:
    """The members' spins, the nominal one first, and whether the mode exists for the first draw of each.

    A member is the same in ensembles of every size.
    """
    spin, seed = scenario.spin, jax.random.key(scenario.seed)
    known = np.array([[x.value, *x.sides()] for x in spin.measured().values()])
    known[:, 1:] /= scenario.sigmas
    phases = np.deg2rad([spin.precession_phase_deg, spin.rotation_phase_deg])
    spins, good = _draw_member(seed, jnp.arange(scenario.members), known, phases, spin.long_axis)
    good = np.asarray(good)
    if failed := int((~good.any(axis=1)).sum()):
        raise ValueError(f"{failed} members: none of {_TRIES} draws within the errors is a {spin.mode} mode")
    return spins, good[:, 0]


@partial(jax.jit, static_argnums=4)
@partial(jax.vmap, in_axes=(None, 0, None, None, None))
def _draw_member(seed: Array, k: Array, known: Array, phases: Array, long_axis: bool) -> tuple[Spin, Array]:
    """The k-th member, and whether the mode exists for each of its draws, (_TRIES,).

    `known` has a row for each key of `SpinValues`: value, standard deviations below and above.
    """
    key = jax.random.fold_in(seed, k)
    noise = jnp.where(k == 0, 0.0, jax.random.normal(key, (_TRIES, 6)))
    drawn = known[:, 0] + jnp.where(noise < 0, known[:, 1], known[:, 2]) * noise
    least, middle, precession, rotation = drawn.T[:4]
    ordered = (least > 0) & (least < middle) & (middle < 1)
    J = jnp.stack([jnp.where(ordered, least, 0.5), jnp.where(ordered, middle, 0.75), jnp.ones_like(least)], axis=1)
    exists = jax.vmap(lambda J, ratio: _free_body.mode_exists(J, ratio, long_axis))(J, rotation / precession)
    good = ordered & exists
    first = jnp.argmax(good)
    longitude, latitude = _along_great_circle(*jnp.deg2rad(known[4:, 0]), *jnp.deg2rad(drawn[0, 4:] - known[4:, 0]))
    uniform = jax.random.uniform(jax.random.fold_in(key, 1), (2,)) * 2 * jnp.pi
    phi, psi = jnp.where(k == 0, phases, uniform)
    return Spin(least[first], middle[first], precession[first], rotation[first], longitude, latitude, phi, psi), good


def _along_great_circle(longitude: Array, latitude: Array, east: Array, north: Array) -> tuple[Array, Array]:
    """The longitude and latitude at the end of an arc (east, north) of a great circle, rad."""
    pole = direction(longitude, latitude)
    to_east = jnp.stack([-jnp.sin(longitude), jnp.cos(longitude), jnp.zeros_like(longitude)])
    to_north = direction(longitude, latitude + jnp.pi / 2)
    away = east * to_east + north * to_north
    x, y, z = so3.Ad(so3.exp(jnp.stack(vectors.cross(pole, away))), pole)
    return jnp.arctan2(y, x), jnp.arcsin(z)


class Study(NamedTuple):
    """The contents of the report and the pictures."""

    before: Outcome  # the spins of the members before the passage
    after: Outcome  # those after it
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
    grid, first = phases(scenario), _first_members(scenario, CHECKED)
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
    count = min(CHECKED, run.state.q.shape[1])
    step_error = float(np.max(_angles(fine.q[:count], run.state.q[-1, :count])))
    failed = sum(int((~x.converged).sum()) for x in (mapped, fine, *arcs.values(), *variants.values()))
    return Study(before, after, grid, mapped, by_unknown, step_error, arcs, variants, failed)


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
    return jax.tree.map(lambda x: x[:count], members(at_least)[0])


def _passages_of_variant(scenario: Flyby, variant: Any, count: int) -> Passage:
    """The passages of `count` members under the assumptions of a variant."""
    spin = scenario.spin.with_changes(variant)
    orbit = scenario.orbit.model_copy(update={"frame": variant.frame or scenario.orbit.frame})
    spins = _first_members(scenario.model_copy(update={"spin": spin}), count)
    return motion.passages(scenario.order, spin.long_axis)(spins, orbit.elements(), scenario.times())


class SpinChange(NamedTuple):
    """The changes of the members' spins by a passage."""

    momentum: np.ndarray  # |π| after, over that before
    rate: np.ndarray  # 2H/|π| after, over that before
    pole_angle: np.ndarray  # the angle between the poles before and after, in degrees
    longitude: np.ndarray  # the change of the pole's longitude, in degrees
    latitude: np.ndarray  # the change of the pole's distance from the ecliptic, in degrees
    same_mode: np.ndarray  # whether the mode is the same


def change_of_spin(before: Outcome, after: Outcome) -> SpinChange:
    """The changes of the members."""
    longitudes, latitudes = np.asarray(longitude_latitude(np.stack([before.pole, after.pole]))).transpose(2, 0, 1)
    return SpinChange(
        after.momentum / before.momentum,
        after.rate / before.rate,
        np.rad2deg(angles(before.pole, after.pole)),
        (longitudes[1] - longitudes[0] + 180) % 360 - 180,
        abs(latitudes[1]) - abs(latitudes[0]),
        after.long_axis == before.long_axis,
    )


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


@picture(2, 2)
def draw_map(scenario: Flyby, axes: np.ndarray, run: Run) -> None:
    """Plot periods, effective spin rate and rotation of the pole after the passage, over both phases at the perigee."""
    found = study(scenario, run)
    x, after = change_of_spin(found.mapped.before, found.mapped.after), found.mapped.after
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
    x, after, before = change_of_spin(found.before, found.after), found.after, found.before
    panels = (
        ("precession period $P_\\phi$ (h)", after.precession, before.precession[0]),
        ("rotation period $P_\\psi$ (h)", after.rotation, before.rotation[0]),
        ("$|L|$ over that before", x.momentum, 1.0),
        ("effective spin rate $2H/|L|$ over that before", x.rate, 1.0),
        ("rotation of the pole (°)", x.pole_angle, None),
    )
    for ax, (label, values, initial) in zip(axes, panels, strict=False):
        top = np.quantile(values, 0.99)
        bins = np.linspace(values.min(), top + 0.02 * np.ptp(values[values <= top]), 50)
        parts = [values[~after.long_axis], values[after.long_axis]]
        ax.hist(parts, bins, stacked=True, color=[plots.BLUE, plots.RED], label=["short-axis mode", "long-axis mode"])
        if initial is not None:
            ax.axvline(initial, color=plots.INK, ls="--", lw=1.0, label="before (nominal)")
        ax.set(xlabel=label, ylabel="members")
    axes[0].legend()
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
        ax.scatter(np.deg2rad(longitude), 90 - side * latitude, s=1.0, lw=0, color=color, alpha=0.35, rasterized=True)
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
