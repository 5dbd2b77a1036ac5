"""Pages and pictures of the site that are files elsewhere in the repository, and stay there."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
CORRECTIONS = ROOT / "lieint_jax" / "corrections.md"
WHERE = "## Where in the paper, where here"
WIDE = "---\nhide: [toc]\n---\n\n"  # for tables that need the room
TITLES = {
    "free_rigid_body": "Free rigid bodies",
    "work_precision": "Work and precision",
    "heavy_top": "Heavy tops",
    "pseudo_rigid": "Elastic bodies",
    "driven": "Satellites",
    "satellite": "Satellites with five laws",
    "attitude": "The attitude of a tumbling stage",
    "bodies": "Several bodies",
    "rods": "Rods",
    "thermostat": "Free bodies in a heat bath",
    "tides": "Angular momentum under tides",
    "se3": "SE(3)",
    "rates": "Given rates",
    "engines": "Steps for engines",
    "gradients": "Gradients",
    "one_body": "One body",
    "loops": "Runs in your own jit",
    "tangent": "Tangent vectors",
    "scan": "Loops of others",
    "ensemble": "Ensembles",
    "gpu_kernels": "On a GPU",
    "first_ensembles": "First ensembles",
    "compile": "First calls",
    "scale": "Scale",
    "store": "Stores",
    "round_off": "Rounding, 10⁷ steps",
    "round_off_long": "Rounding, 10⁸ steps",
}


def on_files(files, config):
    """Add them to the files of the site."""
    pages = {
        "changelog.md": _text("CHANGELOG.md"),
        "contributing.md": _text("CONTRIBUTING.md"),
        "maintaining.md": _text("docs/maintaining.md"),
        "tests.md": _text("tests/README.md"),
        "benchmarks/index.md": _text("benchmarks/RESULTS.md"),
        "corrections.md": _corrections(),
        "paper.md": _paper(),
    }
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.md")):
        pages[f"benchmarks/results/{path.name}"] = _table(path)
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=text))
    for path in (ROOT / "benchmarks" / "results").glob("*.png"):
        files.append(File.generated(config, f"benchmarks/results/{path.name}", abs_src_path=str(path)))
    for path in (ROOT / "notebooks" / "images").glob("*.png"):
        files.append(File.generated(config, f"images/{path.name}", abs_src_path=str(path)))
    return files


def _text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def _table(path):
    """The tables of one benchmark, with a title and, where there is one, its picture."""
    picture = f"\n![{TITLES[path.stem]}]({path.stem}.png)\n" if path.with_suffix(".png").is_file() else ""
    script = "round_off" if path.stem.startswith("round_off") else path.stem
    origin = f"Written by `python benchmarks/{script}.py`, read in [Results](../index.md).\n"
    text = path.read_text(encoding="utf-8").replace("](", "]\\(")  # compose[suzuki](…) is no link
    return f"{WIDE}# {TITLES[path.stem]}\n\n{origin}{picture}\n{text}"


def _parts():
    """corrections.md before, in and after its table from the paper to the package."""
    before, rest = CORRECTIONS.read_text(encoding="utf-8").split(WHERE)
    table, after = re.split(r"\n(?=## )", rest, maxsplit=1)
    return before, table.strip(), after


def _corrections():
    before, _, after = _parts()
    pointer = "The table from the paper's sections to files and tests is [a page of its own](paper.md).\n"
    return WIDE + f"{before}{after}".replace("\n## ", f"\n{pointer}\n## ", 1)


def _paper():
    introduction = (
        "# The paper, section by section\n\n"
        "D. Lewis & J. C. Simo (1994), *Conserving Algorithms for the Dynamics of Hamiltonian Systems on Lie Groups*, "
        "J. Nonlinear Sci. 4, 253–299, [doi:10.1007/BF02430634](https://doi.org/10.1007/BF02430634). Each row leads "
        "from a section to the file that has its formulas and to a test of them; the tests look up every row. "
        "Printed formulas that do not hold are in [Corrections](corrections.md).\n\n"
    )
    return WIDE + introduction + _parts()[1] + "\n"
