"""The way to the terminal: the application prints by `show`, and texts of files pass `readable`."""

from __future__ import annotations

import sys
from typing import Any

from lieint_jax import _checks

_PROSE = 500  # characters of a text in a report


def show(*lines: object, error: bool = False) -> None:
    """Print lines on stdout or stderr, with control and format characters escaped."""
    text = _checks.printable("\n".join(map(str, lines)), sys.maxsize, keep="\n")
    print(text, file=sys.stderr if error else sys.stdout, flush=True)


def readable(tree: Any, most: int = _PROSE) -> Any:
    """A tree of tables, lists and scenarios with texts that can be printed: escaped, each on one line and cut."""
    if isinstance(tree, str):
        return _checks.printable(tree, most)
    if isinstance(tree, dict):
        return {readable(key, most): readable(value, most) for key, value in tree.items()}
    if isinstance(tree, list):
        return [readable(value, most) for value in tree]
    if hasattr(tree, "model_copy"):
        fields = {**tree.__dict__, **(tree.model_extra or {})}
        return tree.model_copy(update={name: readable(value, most) for name, value in fields.items()})
    return tree
