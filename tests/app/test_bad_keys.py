"""Keys that no scenario can have, of every kind: each is refused in one line that names it."""

import functools
from typing import Any

import data_files
import pytest

from lieint_jax.app import scenarios

OWN = {path.stem for path in (data_files.FOLDER / "scenarios").iterdir()}
ROWS = [
    pytest.param(name, row, id=f"{name}-{k}", marks=[pytest.mark.long] * (name == "apophis"))
    for name, rows in data_files.table("bad_keys").items()
    for k, row in enumerate(rows)
]


def place(table: Any, path: str) -> tuple[Any, Any]:
    """The inner table or list of a dotted key, and its last part: a key or an index."""
    *outer, last = [int(part) if part.isdecimal() else part for part in path.split(".")]
    return functools.reduce(lambda t, k: t[k] if isinstance(t, list) else t.setdefault(k, {}), outer, table), last


@pytest.mark.parametrize(("name", "row"), ROWS)
def test_a_bad_key_is_named_in_one_line(name, row):
    table = data_files.table(f"scenarios/{name}") if name in OWN else scenarios.table(name)
    for path in row.get("without", []):
        inner, last = place(table, path)
        del inner[last]
    for path, value in row.get("keys", {}).items():
        inner, last = place(table, path)
        inner[last] = value
    with pytest.raises(ValueError, match=row["message"]) as found:
        scenarios.parse(table, name)
    assert "\n" not in str(found.value)
