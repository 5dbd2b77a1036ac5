"""The option `--set KEY=VALUE`: other values of keys of a scenario, inside tables too, checked like those of a file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from lieint_jax import _checks
from lieint_jax.runs import store as archives

_PART = re.compile(r'"([^"]*)"|([^."]+)')  # of a key
_KEY = re.compile(rf"(?:{_PART.pattern})(?:\.(?:{_PART.pattern}))*")
_WORDS = re.compile(r"([^\W\d]|\d{4}-)[^\[\]{}\"'=#\n]*")  # a text or a date without quotes


def set_key(table: dict[str, Any], text: str) -> None:
    """Give a key of a table the value of a text KEY=VALUE.

    KEY is a path such as `state.quaternion`; a table of a list has its `name` or number, from 1, as in `[spread]`, and
    a part that contains dots is quoted. VALUE is a value of TOML or a text without quotes; an empty one removes it.

    Raises:
        ValueError: no such table of a list, or no value; the message names the key.
    """
    key, equals, value = (part.strip() for part in text.partition("="))
    path = [quoted or plain for quoted, plain in _PART.findall(key)]
    if not equals or not _KEY.fullmatch(key):
        raise ValueError(f"--set {_checks.printable(text)}: give KEY=VALUE, such as dt=0.1")
    try:
        _assign(table, path, value)
    except ValueError as error:
        raise ValueError(f"--set {_checks.printable(key)}: {error}") from error


def _assign(table: dict[str, Any], path: Sequence[str], text: str) -> None:
    """Give the key at a path its value. What is no table becomes one, so that the scenario refuses it by name."""
    part, *rest = path
    inner = table.get(part)
    if rest and isinstance(inner, list) and inner and all(isinstance(row, dict) for row in inner):
        names = [str(row.get("name", k)) for k, row in enumerate(inner, 1)]
        numbers = [str(k) for k in range(1, len(inner) + 1)]
        if rest[0] not in (*names, *numbers) or not rest[1:]:
            raise ValueError(f"{part} is a list of tables: give a key of {' or '.join(names)}, such as {names[0]}.KEY")
        _assign(inner[(names if rest[0] in names else numbers).index(rest[0])], rest[1:], text)
    elif rest:
        table[part] = inner if isinstance(inner, dict) else {}
        _assign(table[part], rest, text)
    elif text:
        table[part] = _value(text)
    elif table.pop(part, None) is None:
        known = f"the keys are {', '.join(table)}" if table else "its table has no keys"
        raise ValueError(f"there is no such key to remove; {known}")


def _value(text: str) -> object:
    """The value of a text, as TOML reads it, or the text itself if it has no quotes and is no such value."""
    try:
        values = archives.parse_toml(f"value = {text}")
    except ValueError as error:
        if _WORDS.fullmatch(text):
            return text
        raise ValueError(f"must be a value of TOML, such as 0.1, [1, 0, 0] or text, got {text}: {error}") from error
    if len(values) > 1:
        raise ValueError(f"must be a value of TOML, got several lines: {text}; give each key a --set of its own")
    return values["value"]
