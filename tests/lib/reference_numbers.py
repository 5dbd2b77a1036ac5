"""The published numbers of `tests/data/reference_numbers.toml`."""

import tomllib
from pathlib import Path

ENTRIES = tomllib.loads((Path(__file__).parents[1] / "data" / "reference_numbers.toml").read_text(encoding="utf-8"))


def numbers(name):
    """Quantity ↦ numbers of an entry."""
    return ENTRIES[name]["numbers"]
