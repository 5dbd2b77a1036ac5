"""The report of `driven.py`: tables, and bars held or missed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lib import report
from lib.precision_report import milliseconds, setting
from lib.report import BATCH, rate
from lib.satellites import APART, COUNTED, SHARED, TOP

_TSIT5 = ("diffrax Tsit5, vmapped, wide vectors", "diffrax Tsit5, one solve of the batch, wide vectors")
_OF_A_TOP, _FASTER = 0.5, 10.0  # bars: rate over that of the heavy top, and over that of Tsit5
_ERRORS = (1e-3, 1e-5, 1e-7, 1e-8)


def write(result: dict[str, Any], out: Path) -> None:
    """Print the tables; write them as .md and the numbers as .json."""
    report.publish("driven", _sections(result), result, out)


def _sections(result: dict[str, Any]) -> list[str]:
    doubt = result["reference_doubt"]
    return [
        report.machine(result),
        *result["notes"],
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        f"Rates, {BATCH} bodies, one core: millions of body-steps a second",
        report.rates(result["rates"], {"heavy top": TOP}, SHARED),
        "Bars",
        _bars(result["rates"]),
        f"Milliseconds per 1000 bodies for an attitude error (rad, worst of 16 bodies) at t = {result['end']:.4g}, "
        "interpolated between the points of a curve; in brackets, over the time of the best of ours",
        _times(result["points"]),
        f"All points. The two references are apart by {doubt:.1e} rad",
        _points(result["points"], doubt),
    ]


def _bars(records: list[dict[str, Any]]) -> str:
    ours, top = rate(records, SHARED), rate(records, TOP)
    vmapped, whole = (rate(records, name) for name in _TSIT5)
    rows = []
    for name, ratio, bar in (
        ("shared t ÷ heavy top", ours / top, _OF_A_TOP),
        ("shared t, work counted ÷ heavy top", rate(records, COUNTED) / top, None),
        ("t per member ÷ heavy top", rate(records, APART) / top, None),
        ("shared t ÷ Tsit5, vmapped", ours / vmapped, _FASTER),
        ("shared t ÷ Tsit5, one solve of the batch", ours / whole, _FASTER),
    ):
        rows.append(
            [name, f"{ratio:.3g}", *(["", ""] if bar is None else [f"≥ {bar:g}", report.verdict(ratio, ratio >= bar)])]
        )
    return report.table(["rates of the splitting, float64, one core", "measured", "bar", ""], rows)


def _times(points: list[dict[str, Any]]) -> str:
    mine = {r["curve"]: r["ours"] for r in points}
    best = {error: min(milliseconds(points, name, error) for name, ours in mine.items() if ours) for error in _ERRORS}
    rows = []
    for name in mine:
        found = {error: milliseconds(points, name, error) for error in _ERRORS}
        rows.append(
            [name, *(f"{ms:.3g} ({ms / best[error]:.2g})" if ms < float("inf") else "" for error, ms in found.items())]
        )
    return report.table(["", *(f"{error:g}" for error in _ERRORS)], rows)


def _points(points: list[dict[str, Any]], doubt: float) -> str:
    rows = []
    for r in points:
        failed = " (NOT ALL STEPS CONVERGED)" if r["converged"] is False else ""
        errors = [("≤ " if r[key] <= doubt else "") + f"{r[key]:.1e}" for key in ("error", "median_error")]
        rows.append([r["curve"] + failed, setting(r), f"{r['milliseconds']:.3g}", *errors])
    return report.table(["", "Δt or rtol", "ms", "largest error", "median error"], rows)
