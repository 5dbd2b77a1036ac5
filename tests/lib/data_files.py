"""Files of `tests/data`: the texts of samples, and tables as TOML."""

import tomllib
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "data"


def text(name):
    return (FOLDER / name).read_text(encoding="utf-8")


def table(name):
    """The keys of NAME.toml."""
    return tomllib.loads(text(f"{name}.toml"))
