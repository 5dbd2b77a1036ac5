"""The report of `work_precision.py`: tables, bars held or missed, and a plot; and what other reports take of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lib import report
from lib.precision import COMPOSED, CONVERGED, EXACT, EXTRAPOLATED, GAUSS, ORDER_2, PEERS, PREPROCESSED, ROUGH, TWO_BODY

from lieint_jax import plots

Record = dict[str, Any]
Allowed = Callable[[Record], bool]

ERRORS = (1e-6, 1e-9)
MEDIAN, LARGEST = "median_error", "error"
_SHARED_STEP = "diffrax Dopri8, one solve, adaptive"


class Bar(NamedTuple):
    """The largest time over a rival's for a median error: of the best of ours, and of the best of `gauss`."""

    problem: str
    rival: str
    error: float
    best: float
    gauss: float
    sign: str = "≤"


AIM = "aim ≤"
_DOUBT = "doubt of the references"
_TWO_BODIES = "Didymos and Dimorphos"
BARS = (
    Bar("heavy top", "heyoka", 1e-6, 0.6, 1.0),
    Bar("heavy top", "heyoka", 1e-9, 1.0, 1.1),
    *(Bar(name, "heyoka", error, 1.0, 1.0, AIM) for name in ("gravity gradient", _TWO_BODIES) for error in ERRORS),
    Bar("flyby", _SHARED_STEP, 1e-6, 1.0, 1.0, AIM),
)
FREE_BARS = ((2.5e-9, 1 / 5), (1e-12, 1 / 20))  # largest attitude error at t = 10, and the largest time over Tsit5's
DRIFT = 1e-13
_OF_THE_PAPER = (ORDER_2, COMPOSED, PREPROCESSED, EXACT)
ALLOWED: dict[str, Allowed] = {
    "all of ours": lambda r: r["ours"],
    "without exact, calibrated": lambda r: r["ours"] and r["kind"] != EXACT,
    "compositions alone": lambda r: r["kind"] == COMPOSED,
}


def write(result: Record, out: Path) -> None:
    """Print the tables; write them as .md, the numbers as .json and the plot as .png."""
    report.publish("work_precision", _sections(result), result, out)
    draw(result["problems"], out / "work_precision.png")


def _sections(result: Record) -> list[str]:
    problems = result["problems"]
    return [
        report.machine(result),
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        "Bars: time over a rival's for a median error, each interpolated between the points of its best curve as if "
        "its step or tolerance were chosen for that error",
        _bars(problems),
        *_bars_of_free_bodies(problems),
        *(section for x in problems for section in summary(x)),
        *(section for x in problems for section in table_of_points(x)),
        "\n".join(["Notes", "", *(f"- {note}" for note in result["notes"])]),
    ]


def _points(problems: Sequence[Record], name: str) -> list[Record]:
    return [r for x in problems if f"{x['problem']},".startswith(f"{name},") for r in x["points"]]


def _bars(problems: Sequence[Record]) -> str:
    rows = []
    for bar in BARS:
        points = _points(problems, bar.problem)
        if not points:
            continue
        rival, _ = fastest(points, lambda r, bar=bar: bar.rival in (r["kind"], r["curve"]), bar.error)
        contenders: list[tuple[str, Allowed, float | None]] = [
            ("best of ours", lambda r: r["ours"], bar.best),
            ("gauss", lambda r: r["kind"] in GAUSS, bar.gauss),
            ("gauss, converged", lambda r: r["kind"] == CONVERGED, None),
        ]
        for who, allowed, most in contenders:
            ms, by = fastest(points, allowed, bar.error)
            ratio = ms / rival if np.isfinite(rival) else np.nan
            limit = ["", ""] if most is None else [f"{bar.sign} {most:g}", report.verdict(ratio, ratio <= most)]
            label = f"{bar.problem}, {bar.error:g}: {who} ÷ {bar.rival}"
            rows.append([label, _curve_name(by), *_cells(ms, rival, ratio), *limit])
        (best, _), (whole, by) = (fastest(points, allowed, bar.error) for _, allowed, _ in contenders[1:])
        price = whole / best if np.isfinite(best) else np.nan
        rows.append(
            [f"{bar.problem}, {bar.error:g}: price of convergence", _curve_name(by), *_cells(whole, best, price)]
        )
    return report.table(["", "by", "ms", "÷ ms", "ratio", "bar", ""], [row + [""] * (7 - len(row)) for row in rows])


def _curve_name(record: Record | None) -> str:
    """The curve of a record, and whether its steps converged if they need not."""
    if record is None:
        return ""
    said = {True: ", all converged", False: ", not converged", None: ""}[
        record["converged"] if record["rough"] else None
    ]
    return record["curve"] + said


def _cells(ms: float, rival: float, ratio: float) -> list[str]:
    return [_number(ms), _number(rival), _number(ratio)]


def _number(x: float) -> str:
    return f"{x:.3g}" if np.isfinite(x) else "–"


def _bars_of_free_bodies(problems: Sequence[Record]) -> list[str]:
    """The bars of the free body at t = 10 against Tsit5, and of its energy."""
    soon, points, rows = _points(problems, "free body, t = 10"), _points(problems, "free body"), []
    if not soon:
        return []
    for error, share in FREE_BARS:
        tsit5, _ = fastest(soon, lambda r: r["curve"].startswith("diffrax Tsit5"), error, LARGEST)
        for which, allowed in ALLOWED.items():
            ms, by = fastest(soon, allowed, error, LARGEST)
            ratio = ms / tsit5 if np.isfinite(tsit5) else np.nan
            bar = [f"≤ {share:g}", report.verdict(ratio, ratio <= share)]
            rows.append([f"{error:g} rad, {which} ÷ Tsit5", _curve_name(by), *_cells(ms, tsit5, ratio), *bar])
    worst = max((r for r in points if r["kind"] in _OF_THE_PAPER), key=lambda r: r["energy_drift"])
    drift = worst["energy_drift"]
    verdict = report.verdict(drift, drift <= DRIFT)
    where = f"{worst['curve']}, {setting(worst)}"
    rows.append(["energy drift, every point of these", where, "", "", f"{drift:.1e}", f"≤ {DRIFT:g}", verdict])
    title = "Bars of the free body at t = 10 for the largest error, ours in a compiled loop without `li.run`"
    return [title, report.table(["", "by", "ms", "÷ ms", "ratio", "bar", ""], rows)]


def summary(found: Record) -> list[str]:
    """The table of the times of each family for some errors, with its title."""
    points = found["points"]
    rivals = [fastest(points, lambda r: r["kind"] == "heyoka", error)[0] for error in ERRORS]
    families: dict[str, Allowed] = {"best of ours": lambda r: r["ours"]}
    for kind in dict.fromkeys(r["kind"] for r in points):
        families[kind] = lambda r, kind=kind: r["kind"] == kind
    rows = []
    for name, allowed in families.items():
        row = [name]
        for error, rival in zip(ERRORS, rivals, strict=True):
            ms, by = fastest(points, allowed, error)
            row += [_curve_name(by), _number(ms), _number(ms / rival if np.isfinite(rival) else np.nan)]
        rows.append(row)
    title = (
        f"{found['problem']}: milliseconds per 1000 members for a median error ({found['error']}), and over heyoka's; "
        "each family by its best curve, – where none reaches the error"
    )
    return [title, report.table(["", *(cell for e in ERRORS for cell in (f"{e:g}, by", "ms", "÷ heyoka"))], rows)]


def fastest(
    records: Sequence[Record], allowed: Allowed, error: float, key: str = MEDIAN
) -> tuple[float, Record | None]:
    """The least time of the allowed curves for an error, and that curve's slower point; inf and None if none has it."""
    names = dict.fromkeys(r["curve"] for r in records if allowed(r))
    found = [(*_interpolated(records, name, error, key), name) for name in names]
    ms, record, _ = min(found, key=lambda x: x[0], default=(np.inf, None, ""))
    return ms, record


def milliseconds(records: Sequence[Record], curve: str, error: float, key: str = LARGEST) -> float:
    """The time of a curve for an error; inf beyond its finest point."""
    return _interpolated(records, curve, error, key)[0]


def _interpolated(records: Sequence[Record], curve: str, error: float, key: str) -> tuple[float, Record | None]:
    """The time for an error, linear in log-log between the points of `front`, and the point that has the error."""
    points = front([r for r in records if r["curve"] == curve], key)
    fine = [r for r in points if r[key] <= error]
    if not fine:
        return np.inf, None
    coarse = [r for r in points if r[key] > error]
    after, before = fine[0], coarse[-1] if coarse else fine[0]
    (e0, t0), (e1, t1) = ((r[key], r["milliseconds"]) for r in (before, after))
    return float(t1 if e0 == e1 else t0 * (t1 / t0) ** (np.log(e0 / error) / np.log(e0 / e1))), after


def front(records: Sequence[Record], key: str) -> list[Record]:
    """Those good records than which none is both faster and more accurate, the fastest first."""
    found: list[Record] = []
    for r in sorted(filter(is_valid, records), key=lambda r: r["milliseconds"]):
        if np.isfinite(r[key]) and (not found or r[key] < found[-1][key]):
            found.append(r)
    return found


def is_valid(record: Record) -> bool:
    """Whether all steps converged, or need not."""
    return record["converged"] is not False or record["rough"]


def setting(record: Record) -> str:
    return f"{'rtol' if record['adaptive'] else 'Δt'} {record['setting']:.3g}"


def table_of_points(found: Record) -> list[str]:
    """The table of all points of a problem, with its title."""
    rows = []
    for r in found["points"]:
        failed = (
            "" if r["converged"] is not False else " (not converged)" if r["rough"] else " (NOT ALL STEPS CONVERGED)"
        )
        doubts = ((MEDIAN, "median_doubt"), (LARGEST, "reference_doubt"))
        errors = [("≤ " if r[key] <= found[doubt] else "") + f"{r[key]:.1e}" for key, doubt in doubts]
        drift = "–" if r["energy_drift"] is None else f"{r['energy_drift']:.1e}"
        steps = "" if r["adaptive"] else str(r["steps"])
        rows.append([r["curve"] + failed, setting(r), steps, f"{r['milliseconds']:.3g}", *errors, drift])
    return [
        f"{found['problem']}, {found['bodies']} members: milliseconds per 1000, errors ({found['error']}), largest "
        f"relative energy drift. References: {found['references']}, apart by {found['median_doubt']:.1e} (median) and "
        f"{found['reference_doubt']:.1e} (largest)",
        report.table(["", "Δt or rtol", "steps", "ms", "median error", "largest error", "energy"], rows),
    ]


# A color and a mark each; families that are not here are in the tables only
_LOOKS = {
    EXACT: (plots.WINE, "*"),
    PREPROCESSED: (plots.PURPLE, "<"),
    TWO_BODY: (plots.PURPLE, "p"),
    COMPOSED: (plots.GREEN, "^"),
    CONVERGED: (plots.ORANGE, "v"),
    ROUGH: (plots.RED, "P"),
    EXTRAPOLATED: (plots.BLUE, "X"),
    "splitting": (plots.RED, "v"),
    "splitting, composed": (plots.GREEN, "^"),
    "energy-momentum": (plots.ORANGE, "P"),
    "energy-momentum, composed": (plots.BLUE, "X"),
    "diffrax": (plots.SKY, "s"),
    "astrojax": (plots.WINE, "D"),
    "heyoka": (plots.INK, "o"),
}


@plots.style()
def draw(problems: Sequence[Record], path: Path) -> None:
    """Plot median error against time, a panel for each problem, a curve for each family: the best of its points."""
    columns = min(len(problems), 3)
    rows = -(-len(problems) // columns)
    fig, axes = plots.figure(columns, rows, size=(4.7, 4.1 + 0.9 / rows))
    for ax, found in zip(axes.flat, problems, strict=False):
        _panel(ax, found)
    for ax in axes.flat[len(problems) :]:
        ax.set_axis_off()
    handles = {}
    for ax in axes.flat[: len(problems)]:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    ordered = [name for name in (*_LOOKS, _DOUBT) if name in handles]
    fig.legend(
        [handles[name] for name in ordered],
        ordered,
        loc="outside lower center",
        ncols=min(len(ordered), 2 * columns),
    )
    plots.save(fig, path)


def _panel(ax: Any, found: Record) -> None:
    curves, styles = {}, {}
    for kind, (color, marker) in _LOOKS.items():
        best = front([r for r in found["points"] if r["kind"] == kind], MEDIAN)
        if best:
            curves[kind] = tuple(np.array([r[key] for r in best]) for key in ("milliseconds", MEDIAN))
            line = "--" if kind in PEERS else "-"
            styles[kind] = {"color": color, "marker": marker, "ls": line, "ms": 5.5, "mec": plots.INK, "mew": 0.4}
    plots.loglog_lines(ax, curves, "milliseconds per 1000, one core", f"median error ({found['error']})", styles)
    ax.set_title(found["problem"])
    doubt = max(found["median_doubt"], 1e-16)
    ax.set_ylim(doubt / 10, 5)
    ax.axhspan(doubt / 10, doubt, color=plots.GRAY, alpha=0.3, lw=0, label=_DOUBT)
    ax.get_legend().remove()
