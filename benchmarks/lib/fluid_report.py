"""The report of `se3.py`: tables, and bars held or missed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lib import report
from lib.report import BATCH, TSIT5, rate

OURS = ("ours, exponential map", "ours, Cayley map")
WIDE = ", wide vectors"
FASTER = 2.0  # the bar: rate of steps over that of Tsit5


def write(result: dict[str, Any], out: Path) -> None:
    """Print the tables; write them as .md and the numbers as .json."""
    report.publish("se3", _sections(result), result, out)


def _sections(result: dict[str, Any]) -> list[str]:
    return [
        report.machine(result),
        *result["notes"],
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        f"Rates, {BATCH} bodies on SE(3), one core: millions of body-steps a second",
        report.rates(result["rates"], {"Tsit5": TSIT5}, OURS[0]),
        "Bars",
        _bars(result),
        "Largest error of an entry of q at t = 10, then the largest relative drifts of energy and of spatial momentum "
        "over a long run, worst of 16 bodies",
        report.quality(result["quality"]),
        f"`diagnostics.flow` with all and with half of its steps, at t = 10: {result['reference_doubt']:.1e}",
    ]


def _bars(result: dict[str, Any]) -> str:
    records, rows = result["rates"], []
    for name in OURS:
        for flags in ("", WIDE):
            ratio = rate(records, name) / rate(records, TSIT5 + flags)
            row = [f"{name}: rate ÷ {TSIT5}{flags}", f"{ratio:.3g}", f"≥ {FASTER:g}"]
            rows.append([*row, report.verdict(ratio, ratio >= FASTER)])
    for r in result["quality"]:
        if r["name"] in OURS:
            for key, bar in (("energy_drift", 1e-13), ("momentum_drift", 0.0)):
                row = [f"{r['name']}: {key.replace('_', ' ')} over {r['steps']} steps", f"{r[key]:.2g}", f"≤ {bar:g}"]
                rows.append([*row, report.verdict(r[key], r[key] <= bar)])
    return report.table(["float64, one core", "measured", "bar", ""], rows)
