"""The table of corrections.md from the paper to the package: each file and each test that it names exists."""

import ast
import re
from pathlib import Path

import pytest

import lieint_jax

ROOT, TESTS = Path(lieint_jax.__file__).parent, Path(__file__).parents[1]
SECTIONS = [
    "1.1",
    "1.2",
    "2.1",
    "2.2",
    "3",
    "3.1",
    "3.2",
    "3.3",
    "4",
    "4.1",
    "4.2",
    "5.2",
    "5.3",
    "5.4",
    "6.1.2",
    "6.2",
    "6.3",
]


def rows():
    text = (ROOT / "corrections.md").read_text(encoding="utf-8")
    table = text.split("## Where in the paper, where here")[1].split("\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")][1:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def covered(text):
    """The numbers of equations that a cell names: (5.23)–(5.27) is five of them."""
    found = set()
    for first, last in re.findall(r"\((\d\.\d+)\)(?:–\((\d\.\d+)\))?", text):
        section, low = first.split(".")
        high = int(last.split(".")[1]) if last else int(low)
        assert not last or last.split(".")[0] == section
        found |= {(int(section), k) for k in range(int(low), high + 1)}
    return found


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[0])
def test_a_row_names_a_file_and_a_test_that_exist(row):
    _, what, file, test = row
    assert what
    assert (ROOT / file.strip("`")).is_file()
    module, name = test.strip("`").split("::")
    tree = ast.parse((TESTS / module).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_section_equation_and_result_has_a_row():
    where = [row[0] for row in rows()]
    for section in (*SECTIONS, "App. A", "App. B"):
        assert any(re.match(rf"{re.escape(section)}\b(?!\.)", place) for place in where), section
    equations = set().union(*map(covered, where))
    for section, last in ((1, 6), (2, 29), (3, 29), (4, 22), (5, 53), (6, 46)):
        assert {(section, k) for k in range(1, last + 1)} <= equations, section
    results = {int(k) for place in where for k in re.findall(r"\d+", place.split("Result")[-1]) if "Result" in place}
    assert set(range(1, 17)) <= results
    assert all(any("Fig" in place and str(k) in place for place in where) for k in (1, 2, 3, 5))
