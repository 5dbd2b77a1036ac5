"""The published numbers of `tests/data/reference_numbers.toml`."""

import data_files

ENTRIES = data_files.table("reference_numbers")


def numbers(name):
    """Quantity ↦ numbers of an entry."""
    return ENTRIES[name]["numbers"]
