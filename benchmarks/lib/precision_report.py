"""The report of `work_precision.py`: tables, bars held or missed, and a plot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lib import report

from lieint_jax import plots

Record = dict[str, Any]
BARS = ((2.5e-9, 1 / 5), (1e-12, 1 / 20))  # attitude error at t = 10, and the largest time over Tsit5's
DRIFT = 1e-13
ALLOWED: dict[str, Callable[[Record], bool]] = {
    "all of ours": lambda r: r["kind"] != "peer",
    "without exact, calibrated": lambda r: r["kind"] not in ("peer", "exact"),
    "compositions alone": lambda r: r["kind"] == "composition",
}


def write(result: Record, out: Path) -> None:
    """Print the tables; write them as .md, the numbers as .json and the plot as .png."""
    report.publish("work_precision", _sections(result), result, out)
    draw(result["ends"], out / "work_precision.png")


def _sections(result: Record) -> list[str]:
    doubts = ", ".join(f"{x['reference_doubt']:.1e} at t = {x['end']:g}" for x in result["ends"])
    return [
        report.machine(result),
        *result["notes"],
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        f"The two references, `RigidBody.solution` and `diagnostics.flow`, are apart by {doubts} (rad)",
        "Bars, at t = 10: milliseconds for an error, interpolated between the points of a curve, as if its step were "
        "chosen for it; the cheapest of ours, and the cheaper of Tsit5 with fixed and with adaptive steps",
        _bars(result),
        *(section for x in result["ends"] for section in at(x)),
    ]


def _bars(result: Record) -> str:
    points = result["ends"][0]["points"]
    rows = []
    for error, share in BARS:
        tsit5 = min(milliseconds(points, name, error) for name in ("diffrax Tsit5", "diffrax Tsit5, adaptive"))
        for which, allowed in ALLOWED.items():
            names = dict.fromkeys(r["curve"] for r in points if allowed(r))
            ours, by = min((milliseconds(points, name, error), name) for name in names)
            ratio = ours / tsit5 if np.isfinite([ours, tsit5]).all() else np.nan
            row = [f"{error:g} rad, {which}", by, f"{ours:.2f}", f"{tsit5:.1f}", f"{ratio:.3f}", f"≤ {share:g}"]
            rows.append([*row, report.verdict(ratio, ratio <= share)])
    worst = max(
        (r for x in result["ends"] for r in x["points"] if r["kind"] != "peer"), key=lambda r: r["energy_drift"]
    )
    drift = worst["energy_drift"]
    where = f"{worst['curve']}, {setting(worst)}, t = {worst['steps'] * worst['setting']:g}"
    verdict = report.verdict(drift, drift <= DRIFT)
    rows.append(["energy drift, every point of ours", where, "", "", f"{drift:.1e}", f"≤ {DRIFT:g}", verdict])
    return report.table(["", "by", "ours, ms", "Tsit5, ms", "ratio", "bar", ""], rows)


def milliseconds(records: Sequence[Record], curve: str, error: float) -> float:
    """The time of a curve for an error, interpolated linearly in log-log between its points; inf beyond the finest."""
    mine = [(r["error"], r["milliseconds"]) for r in records if r["curve"] == curve and r["converged"] is not False]
    fine, coarse = [x for x in mine if x[0] <= error], [x for x in mine if x[0] > error]
    if not fine:
        return np.inf
    e1, t1 = min(fine, key=lambda x: x[1])
    e0, t0 = min(coarse, default=(e1, t1))
    return float(t1 if e0 == e1 else t0 * (t1 / t0) ** (np.log(e0 / error) / np.log(e0 / e1)))


def setting(record: Record) -> str:
    return f"{'rtol' if record['adaptive'] else 'Δt'} {record['setting']:.3g}"


def at(found: Record) -> list[str]:
    rows = []
    for r in found["points"]:
        failed = " (NOT ALL STEPS CONVERGED)" if r["converged"] is False else ""
        at_most = "≤ " if r["error"] <= found["reference_doubt"] else ""
        numbers = [f"{r['milliseconds']:.3g}", f"{at_most}{r['error']:.1e}", f"{r['energy_drift']:.1e}"]
        rows.append([r["curve"] + failed, setting(r), *numbers])
    head = ["", "Δt or rtol", "ms", "error", "energy"]
    return [
        f"t = {found['end']:g}: milliseconds per 1000 bodies, attitude error (rad, worst of 16 bodies), relative "
        "energy drift (worst of all)",
        report.table(head, rows),
    ]


_COLORS = {"order 2": "Blues", "composition": "Greens", "preprocessed": "Oranges", "exact": "Reds", "peer": "Greys"}


def draw(ends: Sequence[Record], path: Path) -> None:
    """Plot error against time, one picture for each end."""
    names = {kind: list(dict.fromkeys(r["curve"] for r in ends[0]["points"] if r["kind"] == kind)) for kind in _COLORS}
    styles = {
        name: {"color": color, "marker": marker, "ls": "--" if kind == "peer" else "-", "ms": 4.5}
        for kind, group in names.items()
        for name, color, marker in zip(group, _shades(_COLORS[kind], len(group)), "os^DvPX", strict=False)
    }
    fig, axes = plots.figure(len(ends))
    fig.set_size_inches(5.75 * len(ends), 6.0)
    for ax, found in zip(axes[0], ends, strict=True):
        good = [r for r in found["points"] if r["converged"] is not False]
        curves = {name: (_series(good, name, "milliseconds"), _series(good, name, "error")) for name in styles}
        label = f"attitude error at t = {found['end']:g} (rad)"
        plots.loglog_lines(ax, curves, "milliseconds per 1000 bodies, one core", label, styles)
        ax.set_ylim(found["reference_doubt"] / 10, 5)
        ax.axhspan(found["reference_doubt"] / 10, found["reference_doubt"], color=plots.GREY, alpha=0.3, lw=0)
        ax.get_legend().remove()
    fig.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=5 if len(ends) > 1 else 2,
        frameon=False,
        fontsize="small",
    )
    fig.savefig(path, dpi=130)


def _series(records: Sequence[Record], curve: str, key: str) -> np.ndarray:
    return np.array([r[key] for r in records if r["curve"] == curve])


def _shades(name: str, count: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps[name](x) for x in np.linspace(0.95, 0.45, count)]
