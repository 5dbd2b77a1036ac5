"""Where in the paper, where here: the table of corrections.md, from the marks of the tests.

`@pytest.mark.paper(place, what, file)` names the place in the paper whose result a test proves, what that is, and the
file of the package that has it. `python tests/lib/paper_table.py` prints the table.
"""

import ast
import re
from pathlib import Path
from typing import NamedTuple

TESTS = Path(__file__).parents[1]


class Row(NamedTuple):
    """One mark, and the test that carries it."""

    place: str
    what: str
    file: str
    test: str


def rows():
    """The marks of all tests, in the order of the paper."""
    found = [row for path in sorted(TESTS.glob("*/test_*.py")) for row in _rows_of(path)]
    return sorted(found, key=_position)


def table(rows):
    """The rows as a table in Markdown."""
    lines = [f"| {row.place} | {row.what} | `{row.file}` | `{row.test}` |" for row in rows]
    return "\n".join(["| in the paper | what | file | test |", "|---|---|---|---|", *lines])


def _rows_of(path):
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        for mark in getattr(node, "decorator_list", []):
            if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.paper":
                place, what, file = map(ast.literal_eval, mark.args)
                yield Row(place, what, file, f"{path.relative_to(TESTS).as_posix()}::{node.name}")


def _position(row):
    """Appendices last; then by section, then by the first equation, claims after equations."""
    section = [int(k) for k in re.match(r"[\d.]*", row.place)[0].strip(".").split(".") if k]
    equation, claim = re.search(r"\(\d\.(\d+)\)", row.place), re.search(r"claim (\d)", row.place)
    number = int(equation[1]) if equation else 900 + int(claim[1]) if claim else 999
    return row.place.startswith("App"), section, row.place[:6] if not section else "", number, row.place, row.what


if __name__ == "__main__":
    print(table(rows()))
