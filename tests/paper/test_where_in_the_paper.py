"""Every section, equation and result of the paper has a test that is marked with it; corrections.md has the table."""

import re
from pathlib import Path

import pytest
from paper_table import rows, table

import lieint_jax

ROOT = Path(lieint_jax.__file__).parent
SECTIONS = ["1.1", "1.2", "2.1", "2.2", "3", "3.1", "3.2", "3.3", "4", "4.1", "4.2"]
SECTIONS += ["5.2", "5.3", "5.4", "6.1.2", "6.2", "6.3"]


def covered(text):
    """The numbers of equations that a cell names: (5.23)–(5.27) is five of them."""
    found = set()
    for first, last in re.findall(r"\((\d\.\d+)\)(?:–\((\d\.\d+)\))?", text):
        section, low = first.split(".")
        high = int(last.split(".")[1]) if last else int(low)
        assert not last or last.split(".")[0] == section
        found |= {(int(section), k) for k in range(int(low), high + 1)}
    return found


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.place)
def test_a_mark_names_a_file_of_the_package_or_a_rule_that_stands_beside_its_test(row):
    assert row.what
    assert (ROOT / row.file).is_file() or (ROOT.parent / row.file).is_file()


def test_the_page_of_corrections_has_the_table_of_the_marks():
    """`python tests/lib/paper_table.py` prints it."""
    text = (ROOT / "corrections.md").read_text(encoding="utf-8")
    assert table(rows()) in text


def test_every_section_equation_and_result_has_a_row():
    where = [row.place for row in rows()]
    for section in (*SECTIONS, "App. A", "App. B"):
        assert any(re.match(rf"{re.escape(section)}\b(?!\.)", place) for place in where), section
    equations = set().union(*map(covered, where))
    for section, last in ((1, 6), (2, 29), (3, 29), (4, 22), (5, 53), (6, 46)):
        assert {(section, k) for k in range(1, last + 1)} <= equations, section
    results = {int(k) for place in where for k in re.findall(r"\d+", place.split("Result")[-1]) if "Result" in place}
    assert set(range(1, 17)) <= results
    assert all(any("Fig" in place and str(k) in place for place in where) for k in (1, 2, 3, 5))
