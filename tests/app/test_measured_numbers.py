"""Numbers that pages quote are those of the measurements in benchmarks/results, rounded as the page rounds them."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
if not RESULTS.exists():
    pytest.skip("the sdist has no benchmarks", allow_module_level=True)


def result(name):
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def page(name):
    return re.sub(r"\s+", " ", (ROOT / name).read_text(encoding="utf-8"))


def peers():
    return {x["name"]: x["rate"] for x in result("ensemble")["peers"]["rates"] if x["bodies"] == 1000}


def over_cpp():
    return {x["name"]: x["ours"] / x["C++"] for x in result("ensemble")["cpp"]}


def rate(name):
    return result("ensemble")["sizes"][name]["1000"]


def over_heyoka(label):
    """The ratio of a row of the table of bars, "ours ÷ heyoka"."""
    text = (RESULTS / "work_precision.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| {label} "))
    return float(row.split("|")[5])


def quoted():
    """(page, text around the numbers, the measured numbers in its order)."""
    ours, explicit = rate("so3_midpoint, symplectic κ"), rate("so3_explicit")
    gradient = {x["name"]: x for x in result("gradients")}
    undone, forward = gradient["ours, reversible"], gradient["ours, forward run"]
    first = [x["first"] for x in result("first_ensembles")["rows"]]
    best = {
        (kind, error): over_heyoka(f"{kind}, {error}: best of ours ÷ heyoka")
        for kind in ("heavy top", "gravity gradient", "Didymos and Dimorphos")
        for error in ("1e-06", "1e-09")
    }
    cpp = over_cpp()
    return [
        ("README.md", r"One core steps (\d+) million tumbling bodies a second", [ours / 1e6]),
        ("README.md", r"\((\d+) million by `so3_explicit`\)", [explicit / 1e6]),
        ("README.md", r"(\d+) times as many as diffrax's Tsit5", [ours / peers()["diffrax Tsit5, vmapped"]]),
        ("README.md", r"C\+\+ of the same schemes|and ([\d.]+) to", [cpp["so3_midpoint, symplectic κ"]]),
        ("README.md", r"satellites run in ([\d.]+) of the time", [best["gravity gradient", "1e-06"]]),
        (
            "README.md",
            r"tops in ([\d.]+) to ([\d.]+) and binary asteroids in ([\d.]*\d)",
            [best["heavy top", "1e-06"], best["heavy top", "1e-09"], best["Didymos and Dimorphos", "1e-06"]],
        ),
        ("README.md", r"needs ([\d.]+) MiB", [undone["MiB"]]),
        ("README.md", r"and ([\d.]+) times the forward run", [undone["seconds"] / forward["seconds"]]),
        (
            "docs/pages/speed.md",
            r"`so3_midpoint`, symplectic κ \| (\d+) \| (\d+) \(Newton form\) \| ([\d.]+)",
            [ours / 1e6, ours / 1e6 / cpp["so3_midpoint, symplectic κ"], cpp["so3_midpoint, symplectic κ"]],
        ),
        (
            "docs/pages/speed.md",
            r"splitting of a heavy top \| \d+ \| \d+ \| ([\d.]+)",
            [cpp["splitting of a heavy top"]],
        ),
        (
            "docs/pages/speed.md",
            r"with `increments=False` \| – \| ([\d.]+) \| ([\d.]+)",
            [best["heavy top", "1e-06"], best["heavy top", "1e-09"]],
        ),
        (
            "docs/pages/speed.md",
            r"increments=False\)` \| – \| ([\d.]+) \| ([\d.]+)",
            [best["gravity gradient", "1e-06"], best["gravity gradient", "1e-09"]],
        ),
        (
            "docs/pages/speed.md",
            r"`extrapolate\(bodies, 14\)` \| – \| ([\d.]+) \| ([\d.]+)",
            [best["Didymos and Dimorphos", "1e-06"], best["Didymos and Dimorphos", "1e-09"]],
        ),
        ("docs/pages/speed.md", r"The first `ensemble.run` costs ([\d.]+) to", [min(first)]),
        (
            "docs/pages/speed.md",
            r"SE\(3\) and elastic bodies \(\[table\]|and [\d.]+ to ([\d.]+) for binaries",
            [max(first)],
        ),
    ]


@pytest.mark.parametrize(("where", "pattern", "measured"), [pytest.param(*x, id=x[1][:40]) for x in quoted()])
def test_pages_quote_the_measured_numbers(where, pattern, measured):
    """To within the last digit that the page prints."""
    found = next(match for match in re.finditer(pattern, page(where)) if match.groups() and match[1])
    assert len(found.groups()) == len(measured)
    for text, value in zip(found.groups(), measured, strict=True):
        digits = len(text.partition(".")[2])
        assert abs(float(text) - value) <= 1.001 * 10**-digits, (text, value)
