"""The spin state and inertia ratios of a tumbling satellite from its light alone, with all symmetric solutions.

The object is simulated: a box with two panels in a graveyard orbit above the geostationary ring, near an equinox, seen
from the ground before and after it crosses the Earth's shadow (`satellite.toml`). The study

* finds the minima of its light as events of the motion;
* searches the light curve for two periods, and lists the pairs that would give the same combinations;
* compares many random bodies of these periods with the first session, and fits the best of them to it;
* fits the whole night from the best results, from the images of the best one under every change of space or of body
  axes that may leave the light unchanged, and, for synthetic data sets, from the truth;
* identifies and counts the solutions at which the fits end.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lieint_jax import measure, plots
from lieint_jax.app.studies import _satellite_fit
from lieint_jax.app.studies._satellite_fit import (
    HARMONICS,
    QUANTITIES,
    SPECTRUM,
    STEP,
    UNKNOWNS,
    Ends,
    SatelliteFit,
    search,
    solutions,
)
from lieint_jax.app.studies._satellite_sky import (
    Lightcurve,
    Scene,
    closed_form,
    observe,
    scene,
    scene_minima,
)
from lieint_jax.app.studies.inference import coverage_cells, draw_pulls, table
from lieint_jax.fitting import Fit, inference
from lieint_jax.fitting.tumbling import mean_periods, random_guesses

__all__ = ["SatelliteFit", "draw", "run", "scene", "text"]

_MOST_MINIMA = 60  # more than the first session has


def run(quick: bool = False, progress: bool = True) -> SatelliteFit:
    """Run the whole study; `quick` uses a fifth of the starts and synthetic sets."""
    guesses, starts, continued, sets = (20_000, 200, 40, 20) if quick else (100_000, 1000, 100, 100)
    made = scene()
    session = made.exposures["sessions_min"][0][1]
    curve, synthetic = observe(made, sets)
    found = search(curve.t, curve.magnitude)
    first = curve.truncate(session)
    clock, key = [time.perf_counter()], jax.random.key(made.exposures["seed"])
    guess, begin, candidate = random_guesses(found.candidates, guesses, key)
    order = np.argsort(_satellite_fit.losses(guess, begin, made.facets, first, progress))[:starts]
    guess, begin, candidate = jax.tree.map(lambda leaf: leaf[order], (guess, begin, candidate))
    clock.append(time.perf_counter())
    observed = np.tile(first.magnitude, (starts, 1))
    fits = _satellite_fit.fit_magnitudes(guess, begin, observed, made.facets, first, progress)
    clock.append(time.perf_counter())
    assert fits.starts is not None
    every = measure.light_changes(made.facets, first.sun, first.observer)
    ends, order = solutions(fits.starts.params, begin), np.argsort(fits.starts.loss)
    images = _images(ends.select(order[0]), every)
    several, truth = _join(ends.select(order[:continued]), images), _satellite_fit.true_solution(made)
    # the light curve, and synthetic sets from the truth
    guess, begin = _satellite_fit.parameters(_join(several, *[truth] * sets))
    data = np.concatenate([np.tile(curve.magnitude, (len(several.q), 1)), synthetic])
    night = _satellite_fit.fit_magnitudes(guess, begin, data, made.facets, curve, progress)
    clock.append(time.perf_counter())
    assert night.starts is not None
    after, count = solutions(night.starts.params, begin), len(several.q)
    chosen = int(np.argmin(night.starts.loss[:count]))
    best = after.select(chosen)
    of_night = _ends(night, after, best, every)
    return SatelliteFit(
        title=made.title,
        facets=len(made.facets.areas),
        rate=float(np.linalg.norm(np.rad2deg(made.body.angular_velocity(made.state))) / 60),
        curve=curve,
        session=session,
        periods=np.asarray(jax.jit(mean_periods)(made.body, made.state)),
        minima=scene_minima(made, session, _MOST_MINIMA),
        search=found,
        guesses=guesses,
        changes=every,
        first=_ends(fits, ends, best, every),
        candidate=candidate,
        night=Ends(*(leaf[:continued] for leaf in of_night)),
        images=Ends(*(leaf[continued:count] for leaf in of_night)),
        named=measure.classify_light(images, best, every),
        fit=night,
        estimate=_satellite_fit.estimate(made, curve, night, begin, chosen, count, every),
        light_changes=_light_changes(made, first, curve),
        seconds=np.diff(clock),
        devices=len(jax.devices()),
    )


def _images(best: measure.SpinStates, every: list[measure.LightChange]) -> measure.SpinStates:
    """The images of a solution under the changes of every kind, including the solution itself."""
    return _join(*(change(best) for change in every if change.symmetry == 0))


def _join(*parts: measure.SpinStates) -> measure.SpinStates:
    return measure.SpinStates(*map(np.concatenate, zip(*parts, strict=True)))


def _light_changes(made: Scene, first: Lightcurve, night: Lightcurve) -> np.ndarray:
    middle = len(first.t) // 2
    held = first._replace(sun=first.sun[[middle] * len(first.t)], observer=first.observer[[middle] * len(first.t)])
    q = np.asarray(closed_form(made, night.t)[0])
    change = measure.light_differences
    return np.stack([change(made.facets, q[: len(c.t)], c.sun, c.observer) for c in (held, first, night)])


def _ends(fit: Fit, ends: measure.SpinStates, best: measure.SpinStates, every: list[measure.LightChange]) -> Ends:
    assert fit.starts is not None
    return Ends(fit.starts.loss, measure.classify_light(ends, best, every), fit.starts.success)


def text(found: SatelliteFit) -> str:
    """The report of the study, as text."""
    parts = (_head, _periods, _solutions, _symmetries, _estimate, _published)
    return "\n".join(line for part in parts for line in part(found))


def _head(found: SatelliteFit) -> list[str]:
    c, m = found.curve, found.minima
    phase = np.rad2deg(np.arccos(np.clip((c.sun * c.observer).sum(axis=1), -1, 1)))
    first = (c.t < found.session).sum()
    return [
        f"{found.title}: all of it simulated",
        f"  {found.facets} facets (a box, two two-sided panels), diffuse with a lobe; they do not shade each other",
        f"  {len(c.t)} exposures in {c.t[-1]:.0f} min, {first} before the Earth's shadow and {len(c.t) - first} after "
        f"it; noise {c.noise} mag; phase angle {phase[0]:.0f}° to {phase.min():.0f}° to {phase[-1]:.0f}°",
        f"  mean periods, true: precession {found.periods[0]:.4f} min, rotation {found.periods[1]:.4f} min",
        f"\n  minima of the light before the shadow, as events of the motion: {len(m.t)}",
        f"    at {', '.join(f'{t:.3f}' for t in m.t[:8])}, … min",
        f"    |dm/dt| at most {np.abs(m.slope).max():.1e} mag/min there; the light is at least {m.rise.min():.1e} mag "
        "brighter 0.02 min before and after",
    ]


def _periods(found: SatelliteFit) -> list[str]:
    s, true, width = found.search, 1 / found.periods, float(1 / found.curve.t[-1])  # width: the resolution, 1/min
    jk = measure.combinations(HARMONICS)
    by_chance = [100 * measure.chance_of_match(part @ true, *SPECTRUM, width) for part in (jk, jk[jk[:, 1] % 2 == 0])]
    rows = [("1/min", "period (min)", "variance", "j", "k", "off (1/min)")]
    for f, share in s.peaks:
        j, k, off = measure.combination(f, true, HARMONICS, width)
        rows.append((f"{f:.5f}", f"{1 / f:.2f}", f"{100 * share:.1f}%", str(j), str(k), f"{off:.5f}"))
    lines = [
        "\n  sines in the light, the strongest first, each with the simplest j f_precession + k f_rotation, |j|, |k| ≤ "
        f"{HARMONICS}",
        f"  within {width:.4f} per min (by chance {by_chance[0]:.0f} % of all frequencies are as near to one, "
        f"{by_chance[1]:.0f} % to one with even k)",
        *table(rows, "    "),
        "  pairs of frequencies of a double Fourier series of order 2, the best first, with their true combinations",
    ]
    for pair, left in list(zip(*s.pairs, strict=True))[:6]:
        names = [(f, *measure.combination(f, true, HARMONICS, width)) for f in pair]
        each = "  and  ".join(f"{f:.5f} = ({j:>2}, {k:>2}) {off:+.5f}" for f, j, k, off in names)
        lines.append(f"    {each}   leaves {100 * left:.1f} % of the variance")
    off = np.abs(s.candidates - true).max(axis=1)
    lines += [f"  {len(s.candidates)} pairs (precession, rotation) would give the combinations of the best pair;"]
    if off.min() > width:
        return [*lines, f"  none of them is the true one: the nearest is off by {off.min():.5f} per min"]
    ours = s.candidates[int(off.argmin())]
    return [
        *lines,
        f"  1/{1 / ours[0]:.2f} and 1/{1 / ours[1]:.2f} per min, one of them, is the true one up to "
        f"{ours[0] - true[0]:+.5f} and {ours[1] - true[1]:+.5f} per min",
        f"  (directions rotate by 15°/h, {15 / 360 / 60:.5f} per min, so the light does not show the motion in space)",
    ]


class _Named(NamedTuple):
    """A named solution: how many starts end there, by half turn; their least loss, and that on the night; or inf."""

    counts: np.ndarray
    before: float
    after: float


def _ends_by_name(found: SatelliteFit) -> dict[str, _Named]:
    rows = {}
    for name in dict.fromkeys(change.name for change in found.changes):
        alike = [i for i, change in enumerate(found.changes) if change.name == name]
        ends = [e.loss[np.isin(e.change, alike)].min(initial=np.inf) for e in (found.first, found.images)]
        rows[name] = _Named(np.array([(found.first.change == i).sum() for i in alike]), *map(float, ends))
    return rows


def _solutions(found: SatelliteFit) -> list[str]:
    named, (a, b, c) = _ends_by_name(found), found.seconds
    first, other = found.first, found.first.loss[found.first.change < 0]
    n, night = (found.curve.t < found.session).sum(), len(found.curve.t)
    rows = [("", "all", "identity", *(f"180° {axis}" for axis in "xyz"), "χ² first", "χ² night")]
    for name, (counts, before, after) in sorted(named.items(), key=lambda row: -row[1].counts.sum()):
        if counts.sum() or np.isfinite(after):
            seen = f"{2 * before:.1f}" if np.isfinite(before) else ""
            rows += [(name, counts.sum(), *counts, seen, f"{2 * after:.1f}" if np.isfinite(after) else "none")]
    rows += [("elsewhere", len(other), *[""] * 4, f"{2 * other.min():.1f}" if len(other) else "")]
    right = [k for k, change in enumerate(found.changes) if change.name == measure.SPACE_CHANGES[0]]
    same, some = (100 * share.mean() for share in (np.isin(first.change, right), first.change >= 0))
    return [
        f"\n  {found.guesses} random bodies of these periods compared with the first session: {a:.0f} s on "
        f"{found.devices} devices, compilation included",
        f"  {len(first.loss)} fits to it from the best of them: {b:.0f} s",
        f"  fits to the whole night from {len(found.night.loss)} of the ends and {len(named)} images of the best one, "
        f"and to {len(found.estimate.errors)} synthetic sets: {c:.0f} s",
        "  ends of the starts, by the half turn of the body, which does not change its light; χ² of "
        f"{n} exposures, then of {night}:",
        *table(rows, "    "),
        f"  {same:.1f} % of the starts end at the true motion or one of equal light, {some:.1f} % at a named one; "
        f"{100 * first.success.mean():.0f} % of the fits succeeded",
        f"  {sum(not np.isfinite(x.after) for x in named.values())} of the {len(named)} named solutions are not minima "
        "on the whole night: the fits leave them",
    ]


def _symmetries(found: SatelliteFit) -> list[str]:
    labels = ("fixed, as in the middle of the session", "moving, before the shadow", "moving, the whole night")
    rows = [("directions to Sun and observer", "none", "mirror", "exchange", "both")]
    rows += [(label, *(f"{x:.2g}" for x in row)) for label, row in zip(labels, found.light_changes, strict=True)]
    return [
        "\n  effect of changes in space on the true motion's light, the largest over half turns of the body (mag, rms)",
        *table(rows, "    "),
    ]


def _estimate(found: SatelliteFit) -> list[str]:
    e, chance = found.estimate, inference.chance_errors(len(found.estimate.errors))
    values = np.append(e.value, e.periods), np.append(e.sigma, e.periods_sigma), np.append(e.truth, found.periods)
    names = [*(name for unknown in UNKNOWNS.values() for name in unknown.names), *QUANTITIES]
    compared = [
        (name, f"{x:.4f}", f"{s:.4f}", f"{t:.4f}", f"{(x - t) / s:+.2f} σ")
        for name, x, s, t in zip(names, *values, strict=True)
    ]
    tested = coverage_cells(e.errors)
    rows = [
        ("", "fitted", "± 1σ", "truth", "off", "within 1σ", "2σ", "rms/σ"),
        *((*row, *cells) for row, cells in zip(compared, tested, strict=False)),
        ("all parameters", *[""] * 4, *coverage_cells(e.errors.reshape(-1, 1))[0]),
        ("expected of each", *[""] * 4, "68%", "95%", "1.00"),
        *compared[8:],
    ]
    lines = table(rows, "    ")
    by_chance = f"   ± {chance.within_1:.0f} %, {chance.within_2:.0f} %, {chance.rms:.2f} by chance"
    truth = "itself" if np.allclose(e.facet_symmetry, np.eye(3)) else "after a half turn of the body"
    return [
        f"\n  the best solution, χ² {2 * found.night.loss.min():.1f} for {len(found.curve.t) - 9} degrees of freedom, "
        f"and the truth {truth},",
        f"  and the errors of the fits of {len(e.errors)} synthetic sets",
        *(line + by_chance * (line.split()[0] == "expected") for line in lines),
        f"  the scheme of order 6, in steps of {STEP:g} min, agrees with the closed form to "
        f"{e.integration:.2g} of the noise in every magnitude",
    ]


def _published(found: SatelliteFit) -> list[str]:
    width, true, named = float(1 / found.curve.t[-1]), 1 / found.periods, _ends_by_name(found)
    names = [measure.combination(p.frequency, true, HARMONICS, width) for p in found.search.peaks]
    good = [k for _, k, off in names if abs(off) < width]
    best, mirror = named[measure.SPACE_CHANGES[0]], named[measure.SPACE_CHANGES[1]]
    before, after = 2 * (mirror.before - best.before), 2 * (mirror.after - best.after)
    return [
        "\n  published statements and this fit:",
        "    'At least two different observation geometries … are needed for a unique full solution' of a precessing",
        "      body (Kaasalainen 2001, A&A 376:302). Here the mirror solution's χ² is "
        f"{f'{before:.1f} higher' if np.isfinite(before) else 'not found'} before the shadow, "
        f"{f'{after:.1f} higher' if np.isfinite(mirror.after) else 'no minimum'} in the night.",
        "    A tumbler's light has the harmonics of two frequencies and their linear combinations (Pravec et al. 2005,",
        f"      Icarus 173:108). Here {len(good)} of the {len(names)} strongest sines are within the resolution of "
        f"one; {sum(k % 2 == 0 for k in good)} of these have even k, as the",
        "      symmetry of the facets requires.",
        "    Retired geostationary satellites tumble 'well below … one degree per second' (Binz, Davis, Kelm & Moore,",
        "      Optical survey of the tumble rates of retired GEO satellites, AMOS). Here it is "
        f"{found.rate:.2f}°/s, by choice.",
    ]


_COLORS = {"as it is": plots.INK, "mirror": plots.RED, "exchange": plots.GREEN, "mirror and exchange": plots.ORANGE}
_TITLES = (
    "light before the shadow",
    "spectrum of all the light",
    "pairs of frequencies",
    "ends of the starts, first session",
    "whole night, from each image of the best end",
    "estimate less truth",
)
_SMALL = {"frameon": False, "fontsize": "x-small", "loc": "upper left"}


@plots.style()
def draw(found: SatelliteFit) -> Figure:
    """Plot the light and its minima, both searches for periods, the ends of all starts, the images, and the errors."""
    fig, axes = plots.figure(3, 2)
    panels = (_draw_light, _draw_spectrum, _draw_pairs, _draw_first_session, _draw_night)
    for ax, draw_panel in zip(axes.flat, panels, strict=False):
        draw_panel(ax, found)
    e = found.estimate
    draw_pulls(axes[1, 2], e.errors, (e.value - e.truth) / e.sigma)
    plots.letter_panels(axes, _TITLES)
    fig.suptitle(f"{found.title}, simulated", fontsize="medium")
    return fig


def _draw_light(ax: Axes, found: SatelliteFit) -> None:
    e, c = found.estimate, found.curve
    fine, seen = e.fine_t <= found.session, c.t <= found.session
    ax.plot(e.fine_t[fine], e.fine_light[fine], color=plots.BLUE, lw=0.8, label="fit")
    ax.plot(c.t[seen], c.magnitude[seen], ".", color=plots.INK, ms=3, label="exposures")
    for t in found.minima.t:
        ax.axvline(t, color=plots.GRAY, lw=0.6, zorder=0, label="true minima" if t == found.minima.t[0] else None)
    ax.set(xlabel="t (min)", ylabel="magnitude, zero point unknown")
    ax.set_ylim(e.fine_light.max() + 0.1, e.fine_light.min() - 0.5)
    ax.legend(ncols=3, **_SMALL)


def _draw_spectrum(ax: Axes, found: SatelliteFit) -> None:
    f, power, true = found.search.frequencies, found.search.power, 1 / found.periods
    ax.plot(f, 100 * power, color=plots.BLUE, lw=0.8)
    for value, name in zip(true, "fg", strict=True):
        ax.axvline(value, color=plots.RED, lw=0.8, ls="--")
        ax.annotate(f"{name} ", (value, 0.94), xycoords=("data", "axes fraction"), ha="right", fontsize="small")
    for peak in (p.frequency for p in found.search.peaks[:7]):
        top = (peak, 100 * power[np.abs(f - peak) < 1.5 * (f[1] - f[0])].max())
        near_line = np.abs(peak - true).min() < 0.03 * np.ptp(f)  # there the label is drawn to the right of the line
        place = {"xytext": (3, 2), "ha": "left"} if near_line else {"xytext": (0, 2), "ha": "center"}
        ax.annotate(_name(found, peak), top, textcoords="offset points", va="bottom", fontsize="xx-small", **place)
    ax.set(xlabel="frequency (1/min)", ylabel="variance explained (%)", ylim=(0, 115 * power.max()))
    note = "f, g: true precession, rotation\n(j, k): the simplest jf + kg"
    ax.text(0.97, 0.95, note, transform=ax.transAxes, ha="right", va="top", fontsize="x-small")


def _draw_pairs(ax: Axes, found: SatelliteFit) -> None:
    pairs, left = found.search.pairs.pairs, 100 * found.search.pairs.unexplained
    y = np.arange(len(pairs))[::-1]
    ax.barh(y, left, color=plots.BLUE, height=0.6)
    for height, pair, value in zip(y, pairs, left, strict=True):
        names = " and ".join(_name(found, f) for f in pair)
        ax.text(value + 0.3, height, names, va="center", fontsize="x-small")
    ax.set(xlabel="variance left by a double series of order 2 (%)", xlim=(0, 1.5 * left.max()))
    ax.set_yticks(y, [f"{p[0]:.4f}, {p[1]:.4f}" for p in pairs], fontsize="x-small")
    ax.set_ylabel("frequencies (1/min)")


def _name(found: SatelliteFit, frequency: float) -> str:
    """The combination (j, k) of the true frequencies that a frequency is."""
    j, k, _ = measure.combination(frequency, 1 / found.periods, HARMONICS, 1 / found.curve.t[-1])
    return f"({j}, {k})".replace("-", "−")


def _split_names(found: SatelliteFit) -> list[tuple[str, str]]:
    """The change in space of each change, and the new names of the axes."""
    parts = (change.name.partition(", axes ") for change in found.changes)
    return [(space, axes or "xyz") for space, _, axes in parts]


def _draw_first_session(ax: Axes, found: SatelliteFit) -> None:
    order, names = np.argsort(found.first.loss), _split_names(found)
    chi = 2 * found.first.loss[order] / (found.curve.t <= found.session).sum()
    change, rank = found.first.change[order], np.arange(1, len(order) + 1)
    ax.loglog(rank, chi, ".", color=plots.GRAY, ms=3, label=f"elsewhere ({(change < 0).sum()})")
    for space, color in _COLORS.items():
        for own, mark in ((True, "o"), (False, "x")):
            which = np.array([k >= 0 and (names[k][0], names[k][1] == "xyz") == (space, own) for k in change])
            if which.any():
                label = f"{space}{'' if own else ', axes exchanged'} ({which.sum()})"
                ax.loglog(rank[which], chi[which], mark, color=color, ms=4, label=label)
    ax.set(xlabel="start, by its χ²", ylabel="χ² per exposure")
    ax.legend(**_SMALL)


def _draw_night(ax: Axes, found: SatelliteFit) -> None:
    excess, names = 2 * (found.images.loss - found.night.loss.min()), _split_names(found)
    columns = sorted({axes for _, axes in names})
    for begin, value, end in zip(found.named, excess, found.images.change, strict=True):
        if begin < 0:  # the best end of the first session is no image of that of the night
            continue
        space, axes = names[begin]
        fill = _COLORS[space] if end >= 0 and names[end] == (space, axes) else "none"
        x = columns.index(axes) + 0.15 * (list(_COLORS).index(space) - 1.5)
        ax.plot(x, max(value, 0.5), "o", color=_COLORS[space], mfc=fill, ms=5)
    for space, color in _COLORS.items():
        ax.plot([], [], "o", color=color, ms=5, label=space)
    ax.plot([], [], "o", color=plots.GRAY, mfc="none", ms=5, label="ended elsewhere")
    ax.set(yscale="log", ylim=(0.3, 3e7), ylabel="χ² above the best (0 drawn at 0.5)")
    ax.set_xlabel("principal axes, by their new names")
    ax.set_xticks(range(len(columns)), columns)
    ax.legend(ncols=2, **_SMALL)
