"""Schema of a stored run: required keys, and the shapes that its arrays must share."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from lieint_jax.dates import epoch

_MAX_LENGTH = 10**15  # of an axis of an array
REALS, _FLAGS, COUNTS = ("float32", "float64"), ("bool",), ("int32", "int64")  # of arrays
_Kinds = Mapping[str, tuple[tuple[int, ...], str]]  # shape and dtype by name


class _Kind(NamedTuple):
    """The values that a description may have for a key: a test, and the test in words."""

    accepts: Callable[[object], bool]
    words: str
    required: bool = True


def _is_count(x: object) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and 0 <= x <= _MAX_LENGTH


def _is_date(x: object) -> bool:
    try:
        return x is None or (isinstance(x, str) and bool(epoch(x)))
    except ValueError:
        return False


NAME = re.compile(r"(?!\.)[^/\\\x00-\x1f\x7f-\x9f]+")
_NATURAL = _Kind(_is_count, "an integer ≥ 0")
_COUNT = _Kind(lambda x: _is_count(x) and x > 0, "a positive integer")
_TEXT = _Kind(lambda x: isinstance(x, str), "text")
_TABLE = _Kind(lambda x: isinstance(x, dict), "a table")
_TABLES = _Kind(lambda x: isinstance(x, list) and bool(x) and all(map(_TABLE.accepts, x)), "a list of tables")
_LIST = _Kind(lambda x: isinstance(x, list), "a list")
LENGTHS = _Kind(lambda x: isinstance(x, list) and all(map(_is_count, x)), "a list of lengths")
_TEXT_OR_TABLE = _Kind(lambda x: isinstance(x, str | dict), "text")
_FLAG = _Kind(lambda x: isinstance(x, bool), "true or false")
STORE_KEYS = {
    "progress": _TABLE,
    "run": _TABLE,
    "members": _COUNT,
    "batch": _FLAG,
    "num_steps": _NATURAL,
    "num_entries": _COUNT,
    "member_chunk": _COUNT,
    "time_chunk": _COUNT,
    "parts": _COUNT._replace(required=False),
    "digests": _TABLE,
    "save_every": _Kind(lambda x: x is None or _COUNT.accepts(x), "a positive integer or null"),
    "dt": _Kind(
        lambda x: x is None or (isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e300),
        "a number or null",
    ),
    "reduce": _Kind(lambda x: x is None or isinstance(x, str), "text or null"),
    "per": _Kind(lambda x: x in (None, "member"), '"member" or null'),
    "scheme": _TEXT,
    "system": _TEXT,
    "time_unit": _TEXT,
    "leaves": _LIST,
    "constants": _LIST,
    "description": _TABLE,
}
PROGRESS_KEYS = dict.fromkeys(("commits", "entries", "steps"), _NATURAL) | {"complete": _FLAG}
ARRAY_KEYS = {"shape": LENGTHS, "data_type": _TEXT_OR_TABLE, "codecs": _TABLES, "node_type": _TEXT}
RUN_KEYS = {
    "versions": _Kind(lambda x: isinstance(x, dict) and all(map(_TEXT.accepts, x.values())), "a table of text"),
    "device": _TEXT,
    "own_step": _FLAG,
    "engine": _TEXT,
    "epoch": _Kind(_is_date, "a date with a scale, or null"),
    "compiler_options": _TABLE,
    "num_steps": _NATURAL,
}


def check_table(where: str, found: object, kinds: Mapping[str, _Kind]) -> None:
    """Raise ValueError if a table in a description lacks a key, or has a value of another kind."""
    if not isinstance(found, dict):
        raise ValueError(f"{where} is not a table")
    for key, (accepts, words, required) in kinds.items():
        if key not in found and required:
            raise ValueError(f"{where} has no {key}")
        if key in found and not accepts(found[key]):
            raise ValueError(f"{key} of {where} is not {words}")


def check_run(kinds: _Kinds, leaves: set[str]) -> None:
    """Raise ValueError unless all arrays of a run have the same number of entries and of members."""
    missing = ({"time", "residual", "converged"} | leaves) - set(kinds)
    if missing:
        raise ValueError(f"it has no array {min(missing)}")
    (n, *_), (members, *_) = kinds["p"][0] or (0,), kinds["p"][0][1:] or (0,)
    if not members:
        raise ValueError(f"p has shape {kinds['p'][0]}, not (entries, members, …)")
    expect("time", kinds, REALS, (n,))
    expect("residual", kinds, REALS, (n, members))
    expect("converged", kinds, _FLAGS, (n, members))
    for name in sorted(leaves):
        expect(name, kinds, REALS, (n, members), least=3 if name in ("q", "p") else 2)


def expect(
    name: str, kinds: _Kinds, dtypes: tuple[str, ...], wanted: tuple[int, ...], least: int | None = None
) -> None:
    """Raise ValueError unless an array has one of these dtypes and this shape.

    With `least` it may have more axes than those of `wanted`, and has at least so many.
    """
    shape, dtype = kinds[name]
    if dtype not in dtypes:
        raise ValueError(f"{name} is of {dtype}, not {' or '.join(dtypes)}")
    if len(shape) < (least or 0) or (shape if least is None else shape[: len(wanted)]) != wanted:
        more = f"({', '.join(map(str, wanted))}, …)"
        raise ValueError(f"{name} has shape {shape}, not {wanted if (least or 0) <= len(wanted) else more}")
