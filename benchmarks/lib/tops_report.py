"""The report of `heavy_top.py`: tables, bars held or missed, and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lib import precision_report, report
from lib.report import BATCH, TSIT5, rate

_CPP = {"C++ splitting": "C++ splitting", "C++ energy-momentum": "C++ energy-momentum"}
SPLITTING, ENERGY_MOMENTUM = "ours, splitting", "ours, energy-momentum, cayley κ"
FASTER = 10.0  # the bar: rate of steps over that of Tsit5


def write(result: dict[str, Any], out: Path) -> None:
    """Print the tables; write them as .md, the numbers as .json and the plot as .png."""
    report.publish("heavy_top", _sections(result), result, out)
    precision_report.draw([result["accuracy"]], out / "heavy_top.png")


def _sections(result: dict[str, Any]) -> list[str]:
    apart = [f"- {r['a']} and {r['b']}, after {r['steps']} steps: {r['apart']:.1e}" for r in result["agreement"]]
    return [
        report.machine(result),
        *result["notes"],
        f"Load of the machine before and after: {result['load'][0]:.2f}, {result['load'][1]:.2f}",
        f"Rates, {BATCH} tops, one core: millions of body-steps a second",
        report.rates(result["rates"], _CPP, SPLITTING),
        "Bars",
        _bars(result),
        "Attitude error at t = 10 (radians), then the largest relative drifts of energy and of γ·π over a long run, "
        "worst of 16 tops",
        report.quality(result["quality"]),
        "Kovalevskaya's top, each method at the step that makes it cost as much as the energy-momentum scheme at "
        "Δt = 0.01: the largest relative errors of energy and of the fourth integral K in the halves of the run, worst "
        "of 16 tops",
        _equal_cost(result["equal_cost"]),
        "End states apart by at most\n\n" + "\n".join(apart),
        f"`diagnostics.flow` with all and with half of its steps, at t = 10: {result['reference_doubt']:.1e} rad",
        *precision_report.summary(result["accuracy"]),
        *precision_report.table_of_points(result["accuracy"]),
    ]


def _equal_cost(records: list[dict[str, Any]]) -> str:
    head = ["", "Δt", "steps", "energy, 1st half", "2nd half", "K, 1st half", "2nd half", "converged"]
    rows = [
        [
            r["name"],
            f"{r['dt']:.3g}",
            f"{r['steps']}",
            *(f"{x:.1e}" for x in r["energy"] + r["K"]),
            _said(r["converged"]),
        ]
        for r in records
    ]
    return report.table(head, rows)


def _said(converged: bool | None) -> str:
    return {True: "all", False: "NOT ALL", None: ""}[converged]


def _bars(result: dict[str, Any]) -> str:
    records, rows = result["rates"], []
    for name in (SPLITTING, ENERGY_MOMENTUM):
        ratio = rate(records, name) / rate(records, TSIT5)
        verdict = report.verdict(ratio, ratio >= FASTER)
        rows.append([f"{name}: rate ÷ {TSIT5}", f"{ratio:.3g}", f"≥ {FASTER:g}", verdict])
    for r in result["quality"]:
        if r["name"] == ENERGY_MOMENTUM:
            for key, bar in (("energy_drift", 5e-13), ("momentum_drift", 1e-13)):
                row = [f"{r['name']}: {key.replace('_', ' ')} over {r['steps']} steps", f"{r[key]:.2g}", f"≤ {bar:g}"]
                rows.append([*row, report.verdict(r[key], r[key] <= bar)])
    return report.table(["float64, one core", "measured", "bar", ""], rows)
