"""The report of `bodies.py`: tables, and bars held or missed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lib import report
from lib.binaries import EXTRAPOLATE
from lib.precision_report import milliseconds, setting

_ERRORS = (1e-5, 1e-7, 1e-9)
_BAR_ERROR, _FASTER = 1e-9, 5.0  # the bar: diffrax's time over ours for that error


def write(result: dict[str, Any], out: Path) -> None:
    """Print the tables; write them as .md and the numbers as .json."""
    report.publish("bodies", _sections(result), result, out)


def _sections(result: dict[str, Any]) -> list[str]:
    accuracy = result["accuracy"]
    compiled = accuracy["heyoka_compile_seconds"]
    end = (
        f"for a relative error of x₂ − x₁ (worst of those watched) at t = {accuracy['end']:.4g}, two orbits, "
        "interpolated between the points of a curve; in brackets, over the time of the best of ours"
    )
    return [
        report.machine(result),
        *result["notes"],
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        "Bars: 1000 binaries, times of peers over those of our best, and of our best that keeps the symplectic form",
        _bars(accuracy["many"]),
        f"How long do 1000 binaries take? Milliseconds {end}",
        _times(accuracy["many"]),
        f"And one binary? Milliseconds {end}",
        _times(accuracy["one"]),
        "heyoka compiles its batch of eight binaries in "
        + ("(not installed)" if compiled is None else f"{compiled:.1f} s at most, once for each tolerance"),
        "64 waters: how many steps a second, and how large is the energy's error over one stretch of time, relative to "
        "the kinetic energy, at 1 fs and at the step that makes the run cost as much as that of the slower at 1 fs?",
        _waters(result["waters"]),
        "How does a step of `splitting` grow with the number of bodies? One system; bytes beside its state",
        _growth(result["bodies"], "bodies", ["seconds"]),
        "And with the number of binaries? In one compiled loop of all, with the bytes of that; and in `li.run`",
        _growth(result["systems"], "systems", ["seconds", "ensemble_seconds"]),
        f"All points. `diagnostics.flow` and DOP853 are apart by {accuracy['reference_doubt']:.1e}",
        _points(accuracy),
    ]


def _best(points: Sequence[dict[str, Any]], error: float, ours: bool, named: str = "") -> tuple[float, str]:
    names = dict.fromkeys(r["curve"] for r in points if named in r["curve"] and r["ours"] == ours)
    return min(((milliseconds(points, name, error), name) for name in names), default=(np.inf, ""))


def _bars(points: list[dict[str, Any]]) -> str:
    symplectic = [r for r in points if r["curve"] != EXTRAPOLATE]
    rows = []
    for ours in (points, symplectic):
        mine, by = _best(ours, _BAR_ERROR, True)
        for named, bar in (("Tsit5", _FASTER), ("Dopri8", _FASTER), ("heyoka", None)):
            theirs, which = _best(points, _BAR_ERROR, False, named)
            ratio = theirs / mine if np.isfinite([theirs, mine]).all() else np.nan
            verdict = ["", ""] if bar is None else [f"≥ {bar:g}", report.verdict(ratio, ratio >= bar)]
            rows.append([f"{which or named}: time ÷ that of {by}, error {_BAR_ERROR:g}", f"{ratio:.3g}", *verdict])
    return report.table(["float64, one core", "measured", "bar", ""], rows)


def _times(points: list[dict[str, Any]]) -> str:
    best = {error: _best(points, error, True)[0] for error in _ERRORS}
    rows = []
    for name in dict.fromkeys(r["curve"] for r in points):
        found = {error: milliseconds(points, name, error) for error in _ERRORS}
        cells = (f"{ms:.3g} ({ms / best[error]:.2g})" if ms < np.inf else "" for error, ms in found.items())
        rows.append([name, *cells])
    return report.table(["", *(f"{error:g}" for error in _ERRORS)], rows)


def _waters(records: list[dict[str, Any]]) -> str:
    head = ["", "steps/s", "compile s", "error at 1 fs", "Δt at equal cost, fs", "error"]
    rows = []
    for r in records:
        timed = [f"{r['rate']:.4g}", f"{r['compile_seconds']:.1f}", f"{r['error']:.1e}"]
        rows.append([r["name"], *timed, f"{1e3 * r['equal_dt']:.3g}", f"{r['equal_error']:.1e}"])
    return report.table(head, rows)


def _growth(records: list[dict[str, Any]], by: str, times: list[str]) -> str:
    """Times and bytes, and the exponents of their growth from the row before."""
    keys, rows, before = [*times, "bytes"], [], None
    for r in records:
        row = [str(r[by])]
        for key in keys:
            grown = "" if before is None else f" (^{np.log(r[key] / before[key]) / np.log(r[by] / before[by]):.2f})"
            row.append((f"{r[key] / 1e6:.3g}" if key == "bytes" else f"{1e6 * r[key]:.4g}") + grown)
        rows.append(row)
        before = r
    heads = {"seconds": "µs a step", "ensemble_seconds": "µs a step, li.run", "bytes": "MB"}
    return report.table([by, *(heads[key] for key in keys)], rows)


def _points(accuracy: dict[str, Any]) -> str:
    rows = []
    for count, key in ((1000, "many"), (1, "one")):
        for r in accuracy[key]:
            failed = " (NOT ALL STEPS CONVERGED)" if r["converged"] is False else ""
            error = ("≤ " if r["error"] <= accuracy["reference_doubt"] else "") + f"{r['error']:.1e}"
            rows.append([r["curve"] + failed, str(count), setting(r), f"{r['milliseconds']:.3g}", error])
    return report.table(["", "binaries", "Δt or rtol", "ms", "error"], rows)
