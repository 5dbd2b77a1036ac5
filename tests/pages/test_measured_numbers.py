"""Numbers that pages quote are those of the measurements in benchmarks/results, rounded as the page rounds them."""

import json
import re
from pathlib import Path

import data_files
import pytest

ROOT = Path(__file__).parents[2]
MODES = ("forward", "reverse")
RESULTS = ROOT / "benchmarks" / "results"
QUOTED = data_files.table("quoted_numbers")
if not RESULTS.exists():
    pytest.skip("the sdist has no benchmarks", allow_module_level=True)


def result(name):
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def page(name):
    return re.sub(r"\s+", " ", (ROOT / name).read_text(encoding="utf-8"))


def peers():
    return {x["name"]: x["rate"] for x in result("ensemble")["peers"]["rates"] if x["bodies"] == 1000}


def over_cpp(kind="C++"):
    return {x["name"]: x["ours"] / x[kind] for x in result("ensemble")["cpp"] if kind in x}


def rate(name):
    return result("ensemble")["sizes"][name]["1000"]


def over_heyoka(label):
    """The ratio of a row of the table of bars, "ours ÷ heyoka"."""
    text = (RESULTS / "work_precision.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| {label} "))
    return float(row.split("|")[5])


def over_peer(problem, family, column):
    """A ratio to heyoka of the table of families of a problem; columns 3 and 6 are for errors of 1e-6 and 1e-9."""
    text = (RESULTS / "work_precision.md").read_text(encoding="utf-8")
    section = re.search(rf"^{problem}, [^\n]*milliseconds per 1000 members(.*?)\n[^|\n]", text, re.M | re.S)[1]
    row = next(line for line in section.splitlines() if line.startswith(f"| {family} "))
    return float(row.split("|")[1 + column])


def table(name, label):
    """The cells of the first row that begins with a label: numbers, or text."""
    text = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| {label} "))
    return [float(x) if re.fullmatch(r"[-\d.e]+", x) else x for x in map(str.strip, row.split("|")[1:-1])]


def over_elastica(scheme, steps=None):
    """PyElastica's time ÷ ours for one rod at the same error, with 16 and 32 elements."""
    rows = result("rods")["equal_error"]
    return [x[-1] for x in rows if x[1] == f"ours, {scheme}" and steps in (None, x[2])]


def many_over_elastica(how, drift="890"):
    """The same for 1000 rods: of PyElastica's 24 elements, to our 16 by `splitting` of 890 steps."""
    seconds = dict(result("rods")["many"])
    [ours] = [x for name, x in seconds.items() if name.startswith("ours") and f"splitting, {drift}" in name]
    [theirs] = [x for name, x in seconds.items() if name.startswith("PyElastica, 24") and name.endswith(how)]
    return [theirs / ours]


def energies(code):
    """The relative drifts of the energy of a scheme of ours, or of PyElastica."""
    return [x[5] for x in result("rods")["rows"] if x[1].startswith(code)]


def rod_first_calls():
    """The shortest and the longest first call of a scheme of ours, in s, which compiles it for all step sizes."""
    first = {}
    for n, name, _, *_, seconds, _ in result("rods")["rows"]:
        if name.startswith("ours") and "nystrom" not in name:  # compiled before, for the references
            first.setdefault((n, name), seconds)
    return [min(first.values()), max(first.values())]


def over_step(what, less):
    """The least and the greatest time of a step with tangent vectors over that of the step alone, less some steps."""
    ratios = [x["seconds"][what] / x["seconds"]["step alone"] - less for x in result("tangent")["rows"]]
    return [min(ratios), max(ratios)]


def jvp_over_closed_form():
    ratios = [x["seconds"] for x in result("tangent")["rows"] if x["closed"]]
    ratios = [x["jvp, 1 vector"] / x["tangent, 1 vector"] for x in ratios]
    return [min(ratios), max(ratios)]


def host_part():
    """Milliseconds of short calls of `li.run`: of free bodies, of satellites, and with `reduce`."""
    later = {x["call"]: 1e3 * x["second"] for x in result("compile")["others"]}
    return [later["li.run" + kind] for kind in ("", ", satellites on an orbit", ", the range of the energy")]


def quick_over_jit():
    """The first gradient by `li.jit` over that by `jax.jit`."""
    ratios = [x["quick reverse"]["first"] / x["reverse"]["first"] for x in result("compile")["rows"]]
    return [min(ratios), max(ratios)]


def drift_of_energy():
    rows = result("free_rigid_body")["quality"]
    return [x["energy_drift"] for x in rows if (x["name"], x["dtype"]) == ("ours, symplectic κ", "float64")]


def measured_names():
    """What the rows of `tests/data/quoted_numbers.toml` are computed from."""
    rates = {x["name"]: x for x in result("ensemble")["cpp"]}  # of li.run and of C++, in turn
    ours, explicit, top = (rates[x] for x in ("so3_midpoint, symplectic κ", "so3_explicit", "splitting of a heavy top"))
    gradient = {x["name"]: x for x in result("gradients")}
    undone, forward = gradient["ours, reversible"], gradient["ours, forward run"]
    first = [x["first"] for x in result("first_ensembles")["rows"]]
    best = {
        (kind, error): over_heyoka(f"{kind}, {error}: best of ours ÷ heyoka")
        for kind in ("heavy top", "gravity gradient", "Didymos and Dimorphos")
        for error in ("1e-06", "1e-09")
    }
    cpp, blocks = over_cpp(), over_cpp("C++ in blocks")
    stage, few = result("attitude")["rows"], result("one_body")["gradients"]
    alone = [x["integrate"] / x["ensemble"] for x in result("one_body")["runs"]]
    return globals() | locals()


# for each quantity that several pages quote, the words around it; every page must print one number
QUANTITIES = {
    "time of Tsit5": [r"(\d+) times as many as diffrax's Tsit5", r"which need (\d+) and \d+ times as long"],
    "time of MuJoCo": [r"(\d+) times as many as MuJoCo", r"which need \d+ and (\d+) times as long"],
    "rate of so3_midpoint": [r"One core computes (\d+) million", r"`so3_midpoint`, symplectic κ \| (\d+) \|"],
    "rate of so3_explicit": [r"\((\d+) million by `so3_explicit`\)", r"\| `so3_explicit` \| (\d+) \|"],
    "energy": [r"energy of a tumbling body is off by ([\de.-]+\d)"],
    "energy of Tsit5": [r"diffrax's Tsit5\) by ([\de.-]+\d)", r"off by ([\de.-]+\d) with diffrax's Tsit5"],
    "memory of a gradient": [r"needs ([\d.]+) MiB"],
    "time of a gradient": [r"([\d.]+) times the time of the forward run", r"MiB, ([\d.]+) times the forward run"],
    "closed form": [r"needs? ([\d.]+) of heyoka's time for an error of 1e-6"],
    "binaries": [r"binary asteroids in ([\d.]*\d)", r"`extrapolate\(bodies, 14\)` \| – \| ([\d.]+)"],
    "satellites": [r"satellites run in ([\d.]+)", r"increments=False\)` \| – \| ([\d.]+) \| 0.19"],
}


@pytest.mark.parametrize("patterns", QUANTITIES.values(), ids=QUANTITIES)
def test_all_pages_print_one_number_for_a_quantity(patterns):
    """To within the last digit of the coarser one; at least two pages print it."""
    names = ["README.md", *(p.relative_to(ROOT).as_posix() for p in (ROOT / "docs" / "pages").rglob("*.md"))]
    texts = {name: page(name) for name in names}
    printed = {(name, x) for pattern in patterns for name in names for x in re.findall(pattern, texts[name])}
    assert all(any(re.search(pattern, text) for text in texts.values()) for pattern in patterns)
    assert len({name for name, _ in printed}) >= 2
    numbers = [number(x) for _, x in printed]
    for value, unit in numbers:
        assert all(abs(value - other) <= 1.001 * max(unit, coarse) for other, coarse in numbers if unit != coarse)
        assert all(value == other for other, same in numbers if same == unit), printed


@pytest.mark.parametrize(("where", "pattern", "measured"), [pytest.param(*x, id=x[1][:40]) for x in QUOTED["quoted"]])
def test_pages_quote_the_measured_numbers(where, pattern, measured):
    """To within the last digit that the page prints."""
    found = next(match for match in re.finditer(pattern, page(where)) if match.groups() and match[1])
    measured = eval(measured, measured_names())
    assert len(found.groups()) == len(measured)
    for text, value in zip(found.groups(), measured, strict=True):
        printed, unit = number(text)
        assert abs(printed - value) <= 1.001 * unit, (text, value)


def number(text):
    """The value of a number as pages print it, and one unit of its last digit."""
    mantissa, _, exponent = text.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return float(text), unit


def test_the_page_for_engines_quotes_its_table():
    """Its rows of viscosities 0 and 0.3, to within the last digit that the page prints."""
    measured = {}
    for line in (RESULTS / "engines.md").read_text(encoding="utf-8").splitlines():
        cells = [x.strip() for x in line.strip("|").split("|")]
        if len(cells) == 7 and re.match(r"[\d.]+$", cells[0]):
            measured[float(cells[0]), cells[1]] = [float(x) for x in cells[2:6]]
    rows, viscosity = 0, None
    for line in (ROOT / "docs" / "pages" / "engines.md").read_text(encoding="utf-8").splitlines():
        cells = [x.strip().replace("`", "") for x in line.strip().strip("|").split("|")]
        if len(cells) != 6 or not re.search("MuJoCo|, C$", cells[1]):
            continue
        viscosity = float(cells[0]) if cells[0] else viscosity
        for text, value in zip(cells[2:], measured[viscosity, cells[1]], strict=True):
            printed, unit = number(text)
            assert abs(printed - value) <= 0.501 * unit, (viscosity, cells[1], text, value)
        rows += 1
    assert rows == 10


def test_the_page_for_engines_quotes_its_long_run():
    measured = json.loads((RESULTS / "engines.json").read_text(encoding="utf-8"))
    rows = {(float(t), name): (energy, momentum) for t, name, energy, momentum, _ in measured["long"]}
    page = (ROOT / "docs" / "pages" / "engines.md").read_text(encoding="utf-8")
    table = page.partition("| integrator | energy at 50 |")[2].partition("\n\n")[0].splitlines()[2:]
    assert len(table) == 5
    for line in table:
        name, *texts = (x.strip().replace("`", "").removesuffix(", its default") for x in line.strip("| ").split("|"))
        values = [rows[t, name][0] for t in (50, 200, 500)] + [rows[t, name][1] for t in (50, 500)]
        for text, value in zip(texts, values, strict=True):
            if value == "failed":
                assert text == "failed"
            else:
                printed, unit = number(text)
                assert abs(printed - float(value)) <= 0.501 * unit, (name, text, value)
    found = re.search(r"in ([\d.]+) µs by Euler, ([\d.]+) by `implicitfast`, ([\d.]+) by `discrete` and ([\d.]+)", page)
    for text, value in zip(found.groups(), measured["microseconds"].values(), strict=True):
        assert abs(float(text) - value) <= 0.0501


@pytest.mark.parametrize(
    ("section", "row", "rates", "call"), QUOTED["steps"], ids=lambda x: x if isinstance(x, str) else ""
)
def test_the_page_which_scheme_quotes_times_of_steps_and_of_first_calls(section, row, rates, call):
    text = (ROOT / "docs" / "pages" / "which_scheme.md").read_text(encoding="utf-8")
    part = text.partition(f"## {section}\n")[2].partition("\n## ")[0]
    lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in part.splitlines() if line.startswith("|")]
    names = [x.strip() for x in lines[0]]
    cells = next(line for line in lines if line[0].strip().startswith(row))
    printed = re.findall(r"(\d[\d.]*)(?: \(|,|$)", cells[names.index("step, ns")].strip())
    measured = [1000 / table("ensemble", rate)[1] for rate in rates]
    assert len(printed) == len(measured)
    compiled = (RESULTS / "compile.md").read_text(encoding="utf-8")
    first = float(re.search(rf"^\| {re.escape(call[0])} +\| +{re.escape(call[1])} \| +([\d.]+)", compiled, re.M)[1])
    printed.append(re.match(r"[\d.]+", cells[names.index("first call, s")].strip())[0])
    for text, value in zip(printed, [*measured, first], strict=True):
        assert abs(float(text) - value) <= 0.501 * number(text)[1] + 1e-9, (row, text, value)
