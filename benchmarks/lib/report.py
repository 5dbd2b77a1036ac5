"""The report of `free_rigid_body.py`: tables, and bars held or missed; and the functions that all reports share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

NEWTON, SCALAR = "C++ symplectic, newton form", "C++ symplectic, scalar form"
OURS, CUSTOM = "ours, symplectic κ", "ours, symplectic κ, custom jax.vmap"
TSIT5 = "diffrax Tsit5, vmapped"
BATCH = 1000


def write(result: dict[str, Any], out: Path) -> None:
    """Print the tables; write them as .md and the numbers as .json."""
    publish("free_rigid_body", _sections(result), result, out)


def publish(name: str, sections: Sequence[str], result: Any, out: Path) -> None:
    """Print the sections; write them as name.md and the result as name.json."""
    out.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(sections) + "\n"
    print(text)
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    (out / f"{name}.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(f"written: {out}/{name}.md, .json")


def machine(result: dict[str, Any]) -> str:
    """The machine and the packages, in one line."""
    found = result["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in found["packages"].items() if version)
    return f"{found['cpu']}; Python {found['python']}, {packages}"


def _sections(result: dict[str, Any]) -> list[str]:
    return [
        machine(result),
        *result["notes"],
        f"Rates, {BATCH} bodies, one core: millions of body-steps a second (for scipy a step is a time dt)",
        rates(result["rates"], {"C++ newton": NEWTON, "C++ scalar": SCALAR}, OURS),
        'Millions of body-steps a second by number of bodies; "all": all cores',
        _sizes(result["rates"], result["all_cores"]),
        "Attitude error at t = 10 (radians), then the largest relative drifts over a long run, worst of 16 bodies",
        quality(result["quality"]),
        _agreement(result),
        "Bars",
        _bars(result),
    ]


def rates(records: Sequence[dict[str, Any]], baselines: Mapping[str, str], ours: str) -> str:
    """A table of rates of a batch, over those of `baselines` (column ↦ contestant), and of that of `ours` over each."""
    records = [r for r in records if r["bodies"] == BATCH]
    head = ["", "dtype", "best", "median", *(f"÷ {column}" for column in baselines), "ours ÷ it", "compile s"]
    rows = []
    for r in records:
        over = [r["rate"] / rate(records, name, r["dtype"]) for name in baselines.values()]
        ratios = [f"{x:.3g}" for x in (*over, rate(records, ours, r["dtype"]) / r["rate"])]
        millions = [f"{r[key] / 1e6:.3g}" for key in ("rate", "median_rate")]
        rows.append([r["name"], r["dtype"], *millions, *ratios, f"{r['compile_seconds']:.1f}"])
    return table(head, rows)


def _sizes(one: Sequence[dict[str, Any]], every: Sequence[dict[str, Any]]) -> str:
    batches = sorted({r["bodies"] for r in one})
    batches_all = sorted({r["bodies"] for r in every})
    names = list(dict.fromkeys((r["name"], r["dtype"]) for r in one if r["bodies"] != BATCH))
    rows = []
    for name, dtype in names:
        found = [rate(one, name, dtype, b) for b in batches] + [rate(every, name, dtype, b) for b in batches_all]
        rows.append([name, dtype, *(f"{x / 1e6:.3g}" for x in found)])
    return table(["", "dtype", *map(str, batches), *(f"{b}, all" for b in batches_all)], rows)


def quality(records: Sequence[dict[str, Any]]) -> str:
    """A table of errors, drifts and residuals."""
    head = ["", "dtype", "error", "energy", "momentum", "steps", "residual", "converged"]
    keys = ("error", "energy_drift", "momentum_drift")
    rows = []
    for r in records:
        solved = (
            [f"{r['residual']:.1e}", "all" if r["converged"] else "NOT ALL"] if r["residual"] is not None else ["", ""]
        )
        rows.append([r["name"], r["dtype"], *(f"{r[key]:.2g}" for key in keys), str(r["steps"]), *solved])
    return table(head, rows)


def _agreement(result: dict[str, Any]) -> str:
    reference = "The two references, `RigidBody.solution` and `diagnostics.flow`, at t = 10"
    lines = [f"- {reference}: {result['reference_doubt']:.1e} rad"]
    for r in result["agreement"]:
        lines.append(f"- {r['a']} and {r['b']}, {r['dtype']}, after {r['steps']} steps: {r['apart']:.1e}")
    return "End states apart by at most\n\n" + "\n".join(lines)


def _bars(result: dict[str, Any]) -> str:
    double = [r for r in result["rates"] if r["bodies"] == BATCH]
    ours, custom, newton, scalar, tsit5 = (rate(double, name) for name in (OURS, CUSTOM, NEWTON, SCALAR, TSIT5))
    [quality] = [r for r in result["quality"] if (r["name"], r["dtype"]) == (OURS, "float64")]
    at_least = [
        ("rate ÷ C++ newton form", ours / newton, 1.3),
        ("rate ÷ C++ newton form, custom jax.vmap", custom / newton, 0.45),
        ("rate ÷ C++ scalar form", ours / scalar, 0.45),
        ("rate ÷ C++ scalar form, custom jax.vmap", custom / scalar, 0.45),
        ("rate ÷ diffrax Tsit5 vmapped", ours / tsit5, 15.0),
        ("rate ÷ diffrax Tsit5 vmapped, custom jax.vmap", custom / tsit5, 15.0),
    ]
    at_most = [
        (f"energy drift over {quality['steps']} steps", quality["energy_drift"], 5e-13),
        (f"momentum drift over {quality['steps']} steps", quality["momentum_drift"], 0.0),
    ]
    rows = [[name, f"{x:.3g}", f"≥ {bar:g}", verdict(x, x >= bar)] for name, x, bar in at_least]
    rows += [[name, f"{x:.2g}", f"≤ {bar:g}", verdict(x, x <= bar)] for name, x, bar in at_most]
    return table(["ours: symplectic κ, float64, one core", "measured", "bar", ""], rows)


def verdict(measured: float, held: bool) -> str:
    return "not measured" if np.isnan(measured) else "held" if held else "MISSED"


def rate(records: Sequence[dict[str, Any]], name: str, dtype: str = "float64", bodies: int = BATCH) -> float:
    """The rate of a contestant; nan if it has none."""
    found = [r["rate"] for r in records if (r["name"], r["dtype"], r["bodies"]) == (name, dtype, bodies)]
    return found[0] if found else np.nan


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, aligned to be read as text; columns after the first are flush right, nan is left blank."""
    cells = [["" if cell == "nan" else cell for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rule = ["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])]
    lines = [
        " | ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in (cells[0], rule, *cells[1:])
    ]
    return "\n".join(f"| {line} |" for line in lines)
