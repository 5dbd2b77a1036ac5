"""The report of the study of a satellite, in seven parts."""

from __future__ import annotations

import numpy as np

from lieint_jax.app.studies._period_search import HARMONICS, SPECTRUM, coincidence, combinations, find_combination
from lieint_jax.app.studies._pulls import chance_errors, shares
from lieint_jax.app.studies._satellite_fit import STEP
from lieint_jax.app.studies._satellite_result import SatelliteFit
from lieint_jax.app.studies._symmetric_solutions import SPACE

NAMES = (
    *(f"attitude {a} (°)" for a in "xyz"),
    "inertia ratio Jx/Jz",
    "inertia ratio Jy/Jz",
    *(f"body rate {a} (°/min)" for a in "xyz"),
)


def text(found: SatelliteFit) -> str:
    """The report of the study, as text."""
    parts = (_head, _minima, _periods, _ends, _symmetries, _estimate, _published)
    return "\n".join(line for part in parts for line in part(found))


def _head(found: SatelliteFit) -> list[str]:
    c = found.curve
    phase = np.rad2deg(np.arccos(np.clip((c.sun * c.observer).sum(axis=1), -1, 1)))
    first = (c.t < found.session).sum()
    return [
        f"{found.title}: all of it simulated",
        f"  {found.facets} facets (a box, two two-sided panels), diffuse with a lobe; they do not shade each other",
        f"  {len(c.t)} exposures in {c.t[-1]:.0f} min, {first} before the Earth's shadow and {len(c.t) - first} after "
        f"it; noise {c.noise} mag; phase angle {phase[0]:.0f}° to {phase.min():.0f}° to {phase[-1]:.0f}°",
        f"  mean periods, true: precession {found.periods[0]:.4f} min, rotation {found.periods[1]:.4f} min",
    ]


def _minima(found: SatelliteFit) -> list[str]:
    m = found.minima
    return [
        f"\n  minima of the light before the shadow, as events of the motion: {len(m.t)}",
        f"    at {', '.join(f'{t:.3f}' for t in m.t[:8])}, … min",
        f"    |dm/dt| at most {np.abs(m.slope).max():.1e} mag/min there; the light is at least {m.rise.min():.1e} mag "
        "brighter 0.02 min before and after",
    ]


def _periods(found: SatelliteFit) -> list[str]:
    s, true, width = found.search, 1 / found.periods, _width(found)
    jk = combinations(HARMONICS)
    by_chance = [100 * coincidence(part @ true, SPECTRUM, width) for part in (jk, jk[jk[:, 1] % 2 == 0])]
    lines = [
        "\n  sines in the light, the strongest first, each with the simplest j f_precession + k f_rotation, |j|, |k| ≤ "
        f"{HARMONICS}",
        f"  within {width:.4f} per min (by chance {by_chance[0]:.0f} % of all frequencies are as near to one, "
        f"{by_chance[1]:.0f} % to one with even k)",
        f"    {'1/min':>9}{'period (min)':>14}{'variance':>10}{'j':>5}{'k':>4}{'off (1/min)':>13}",
    ]
    for p in s.peaks:
        j, k, off = find_combination(p.frequency, true, HARMONICS, width)
        lines.append(f"    {p.frequency:>9.5f}{1 / p.frequency:>14.2f}{100 * p.share:>9.1f}%{j:>5}{k:>4}{off:>13.5f}")
    lines.append(
        "  pairs of frequencies of a double Fourier series of order 2, the best first, with their true combinations"
    )
    for pair, left in list(zip(s.pairs.pairs, s.pairs.left, strict=True))[:6]:
        names = [(f, *find_combination(f, true, HARMONICS, width)) for f in pair]
        each = "  and  ".join(f"{f:.5f} = ({j:>2}, {k:>2}) {off:+.5f}" for f, j, k, off in names)
        lines.append(f"    {each}   leaves {100 * left:.1f} % of the variance")
    return [*lines, *_candidates(s.candidates, true, width)]


def _candidates(candidates: np.ndarray, true: np.ndarray, width: float) -> list[str]:
    off = np.abs(candidates - true).max(axis=1)
    ours = candidates[int(off.argmin())]
    lines = [f"  {len(candidates)} pairs (precession, rotation) would give the combinations of the best pair;"]
    if off.min() > width:
        return [*lines, f"  none of them is the true one: the nearest is off by {off.min():.5f} per min"]
    return [
        *lines,
        f"  1/{1 / ours[0]:.2f} and 1/{1 / ours[1]:.2f} per min, one of them, is the true one up to "
        f"{ours[0] - true[0]:+.5f} and {ours[1] - true[1]:+.5f} per min",
        f"  (directions rotate by 15°/h, {15 / 360 / 60:.5f} per min, so the light does not show the motion in space)",
    ]


def _width(found: SatelliteFit) -> float:
    """The resolution in frequency, 1/min."""
    return float(1 / found.curve.t[-1])


def _ends(found: SatelliteFit) -> list[str]:
    rows = _rows(found)
    lost = sum(not row[3] for row in rows)
    first = found.first
    right = [k for k, change in enumerate(found.changes) if change.name == SPACE[0]]
    same, some = (100 * share.mean() for share in (np.isin(first.change, right), first.change >= 0))
    return [
        *_times(found, len(rows)),
        *_table(found, rows),
        f"  {same:.1f} % of the starts end at the true motion or one of equal light, {some:.1f} % at a named one; "
        f"{100 * first.success.mean():.0f} % of the fits succeeded",
        f"  {lost} of the {len(rows)} named solutions are not minima on the whole night: the fits leave them",
    ]


def _times(found: SatelliteFit, images: int) -> list[str]:
    a, b, c = found.seconds
    return [
        f"\n  {found.guesses} random bodies of these periods compared with the first session: {a:.0f} s on "
        f"{found.devices} devices, compilation included",
        f"  {len(found.first.loss)} fits to it from the best of them: {b:.0f} s",
        f"  fits to the whole night from {len(found.night.loss)} of the ends and {images} images of the best one, "
        f"and to {len(found.estimate.errors)} synthetic sets: {c:.0f} s",
    ]


def _table(found: SatelliteFit, rows: list[tuple[str, np.ndarray, float, bool, float]]) -> list[str]:
    n, night = (found.curve.t < found.session).sum(), len(found.curve.t)
    rotations = ("identity", *(f"180° {axis}" for axis in "xyz"))
    lines = [
        "  ends of the starts, by the half turn of the body, which does not change its light; χ² of "
        f"{n} exposures, then of {night}:",
        f"    {'':<32}{'all':>5}" + "".join(f"{t:>9}" for t in rotations) + f"{'χ² first':>11}{'χ² night':>11}",
    ]
    for name, counts, before, own, after in sorted(rows, key=lambda row: -row[1].sum()):
        if counts.sum() or own:
            seen = f"{2 * before:>11.1f}" if np.isfinite(before) else f"{'':>11}"
            later = f"{2 * after:>11.1f}" if own else f"{'none':>11}"
            lines.append(f"    {name:<32}{counts.sum():>5}" + "".join(f"{k:>9}" for k in counts) + seen + later)
    other = found.first.loss[found.first.change < 0]
    return [*lines, f"    {'elsewhere':<32}{len(other):>5}" + (f"{2 * other.min():>47.1f}" if len(other) else "")]


def _rows(found: SatelliteFit) -> list[tuple[str, np.ndarray, float, bool, float]]:
    return [_row(found, name) for name in dict.fromkeys(change.name for change in found.changes)]


def _row(found: SatelliteFit, name: str) -> tuple[str, np.ndarray, float, bool, float]:
    """A named solution: its name, how many starts end there, by half turn, and their least loss; whether it is a
    minimum on the night, and the loss of that minimum."""
    alike = [i for i, change in enumerate(found.changes) if change.name == name]
    counts = np.array([(found.first.change == i).sum() for i in alike])
    before, after = (
        np.min(ends.loss, where=np.isin(ends.change, alike), initial=np.inf) for ends in (found.first, found.images)
    )
    return name, counts, float(before), bool(np.isfinite(after)), float(after)


def _symmetries(found: SatelliteFit) -> list[str]:
    lines = [
        "\n  effect of changes in space on the true motion's light, the largest over half turns of the body (mag, rms)",
        f"    {'directions to Sun and observer':<40}{'none':>10}{'mirror':>10}{'exchange':>10}{'both':>10}",
    ]
    labels = ("fixed, as in the middle of the session", "moving, before the shadow", "moving, the whole night")
    for label, row in zip(labels, found.light_changes, strict=True):
        lines.append(f"    {label:<40}" + "".join(f"{x:>10.2g}" for x in row))
    return lines


def _estimate(found: SatelliteFit) -> list[str]:
    e = found.estimate
    each, every, by_chance = shares(e.errors), shares(e.errors, None), chance_errors(len(e.errors))
    truth = "itself" if np.allclose(e.facet_symmetry, np.eye(3)) else "after a half turn of the body"
    lines = [
        f"\n  the best solution, χ² {2 * found.night.loss.min():.1f} for {len(found.curve.t) - 9} degrees of freedom, "
        f"and the truth {truth},",
        f"  and the errors of the fits of {len(e.errors)} synthetic sets",
        f"    {'':<24}{'fitted':>11}{'± 1σ':>10}{'truth':>11}{'off':>9}{'within 1σ':>12}{'2σ':>6}{'rms/σ':>9}",
    ]
    for k, name in enumerate(NAMES):
        compared = _comparison(name, e.value[k], e.sigma[k], e.truth[k])
        lines.append(f"{compared}{each.within_1[k]:>11.0f}%{each.within_2[k]:>5.0f}%{each.rms[k]:>9.2f}")
    periods = zip(
        ("precession period (min)", "rotation period (min)"), e.periods, e.periods_sigma, found.periods, strict=True
    )
    return [
        *lines,
        f"    {'all parameters':<24}{'':>41}{every.within_1:>11.0f}%{every.within_2:>5.0f}%{every.rms:>9.2f}",
        f"    {'expected of each':<24}{'':>41}{68:>11}%{95:>5}%{1:>9.2f}   ± {by_chance.within_1:.0f} %, "
        f"{by_chance.within_2:.0f} %, {by_chance.rms:.2f} by chance",
        *(_comparison(*row) for row in periods),
        f"  the scheme of order 6, in steps of {STEP:g} min, agrees with the closed form to "
        f"{e.integration:.2g} of the noise in every magnitude",
    ]


def _comparison(name: str, value: float, sigma: float, truth: float) -> str:
    return f"    {name:<24}{value:>11.4f}{sigma:>10.4f}{truth:>11.4f}{(value - truth) / sigma:>+7.2f} σ"


def _published(found: SatelliteFit) -> list[str]:
    width, true = _width(found), 1 / found.periods
    names = [find_combination(p.frequency, true, HARMONICS, width) for p in found.search.peaks]
    good = [k for _, k, off in names if abs(off) < width]
    even = sum(k % 2 == 0 for k in good)
    rows = {row[0]: row for row in _rows(found)}
    best, mirror = rows[SPACE[0]], rows[SPACE[1]]
    before = f"{2 * (mirror[2] - best[2]):.1f} higher" if np.isfinite(mirror[2] - best[2]) else "not found"
    after = f"{2 * (mirror[4] - best[4]):.1f} higher" if mirror[3] else "no minimum"
    return [
        "\n  published statements and this fit:",
        "    'At least two different observation geometries … are needed for a unique full solution' of a precessing",
        "      body (Kaasalainen 2001, A&A 376:302). Here the mirror solution's χ² is "
        f"{before} before the shadow, {after} in the night.",
        "    A tumbler's light has the harmonics of two frequencies and their linear combinations (Pravec et al. 2005,",
        f"      Icarus 173:108). Here {len(good)} of the {len(names)} strongest sines are within the resolution of "
        f"one; {even} of these have even k, as the",
        "      symmetry of the facets requires.",
        "    Retired geostationary satellites tumble 'well below … one degree per second' (Binz, Davis, Kelm & Moore,",
        "      Optical survey of the tumble rates of retired GEO satellites, AMOS). Here it is "
        f"{found.rate:.2f}°/s, by choice.",
    ]
