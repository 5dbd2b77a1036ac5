"""Files that anybody may have written: whatever is wrong with one becomes a ValueError of one sentence.

Devices and pipes are never read, no name in a file leads outside of it, and no size in a file is trusted before it is
compared with the number of bytes.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from lieint_jax import _checks
from lieint_jax.runs._storage.storage import Address

SUFFIXES = (".npz", ".zarr")
JSON_BYTES, _JSON_DEPTH = 2**26, 64  # the most of a description
_REASON = 1000  # characters of a reason in a message
_TOML_BYTES, _TOML_DEPTH = 2**18, 16  # the most of a scenario: the largest shipped one has 7 kB, 2 brackets and 2 parts
_TOML_MARKS = re.compile(  # keys with a dot, brackets, and what may hide them: strings and comments, closed or not
    r'"""[^"\\]*+(?:(?:\\.|"(?!""))[^"\\]*+)*+(?:"{3,5})?+'
    r"|'''[^']*+(?:'(?!'')[^']*+)*+(?:'{3,5})?+"
    r'|"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?|#[^\n]*+|[][{}.=,\n]',
    re.DOTALL,
)


class UnreadableError(ValueError):
    """A file of results that cannot be read; the message is a sentence that names it."""


@contextlib.contextmanager
def wrap_errors(
    path: Address,
    what: str = "is no file of results that lieint wrote, or is damaged",
    passed: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """A context that turns every error into an `UnreadableError`, one sentence about the file at `path`.

    Errors of the operating system and of the types `passed` are raised unchanged.
    """
    try:
        yield
    except (UnreadableError, OSError, *passed):
        raise
    except Exception as error:  # a crafted file can make numpy, zipfile, zarr and json raise anything
        [reason, *_] = str(error).splitlines() or [""]
        if not isinstance(error, ValueError):
            reason = f"its content is invalid, {type(error).__name__} ({reason})"
        raise UnreadableError(f"{path} {what}: {_checks.printable(reason, _REASON)}") from error


def refuse_special(path: Path) -> None:
    """Raise UnreadableError unless there is an ordinary file or a folder at `path`."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        if path.is_symlink():
            raise UnreadableError(f"{path} is a link to {os.readlink(path)}, which does not exist") from None
        named = path if path.suffix in SUFFIXES else path.with_suffix(".npz") if path.name else "NAME.npz"
        raise UnreadableError(f"there is no file {path}; lieint run NAME --out {named} writes one") from None
    except ValueError as error:  # a null character
        raise UnreadableError(f"{str(path)!r} is not the name of a file: {error}") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnreadableError(f"{path} is a device, a pipe or a socket; give a file NAME.npz or a store NAME.zarr")


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text of bounded size and depth."""
    if len(text) > JSON_BYTES:
        raise ValueError(f"its description has {_checks.spoken_size(len(text))}, more than that of any run")
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("its description is nested too deeply") from None
    level = [found]
    for _ in range(_JSON_DEPTH):
        if not level:
            return found
        level = [
            part for x in level if isinstance(x, dict | list) for part in (x.values() if isinstance(x, dict) else x)
        ]
    raise ValueError("its description is nested too deeply")


def read_toml(file: Traversable, name: str) -> dict[str, Any]:
    """The tables of a TOML file of bounded size and depth; error messages begin with its name.

    A file has at most 262 kB, a key at most 16 parts, and brackets are nested at most 16 deep: the standard library's
    parser needs seconds for longer files, and the square of a key's parts in time and memory.
    """
    with file.open("rb") as stream:
        data = stream.read(_TOML_BYTES + 1)
    if len(data) > _TOML_BYTES:
        limit = _checks.spoken_size(_TOML_BYTES)
        raise UnreadableError(f"{name} has more than {limit}: it is no scenario; --save-at FILE reads a list of times")
    text = ""
    try:
        text = data.decode("utf-8-sig")
        return parse_toml(text)
    except UnicodeDecodeError as error:
        raise UnreadableError(f"{name} is not UTF-8 text: {error}") from error
    except ValueError as error:  # of its grammar, or an integer of more digits than Python reads
        reason = str(error)
        more = _missing_quotes(text, reason) if isinstance(error, tomllib.TOMLDecodeError) else ""
        raise UnreadableError(f"{name} is not valid TOML: {_checks.printable(reason)}{more}") from error


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is none; its brackets are nested too deeply, or a key has too many parts.
    """
    depth = dots = 0
    for found in _TOML_MARKS.finditer(text):
        mark = found[0]
        depth += (mark in "[{") - (mark in "]}")
        dots = dots + 1 if mark == "." else 0 if mark in "=,[]{}\n" else dots
        if depth > _TOML_DEPTH or dots >= _TOML_DEPTH:
            what = "brackets are nested" if depth > _TOML_DEPTH else "the parts of a key are nested"
            line = text.count("\n", 0, found.start()) + 1
            raise ValueError(f"{what} more than {_TOML_DEPTH} deep (at line {line})")
    return tomllib.loads(text)


def _missing_quotes(text: str, error: str) -> str:
    """Advice where the line of an error has text without quotes."""
    number = re.search(r"at line (\d+)", error)
    line = text.split("\n")[int(number[1]) - 1].rstrip("\r") if number else ""
    found = re.fullmatch(r"\s*([\w.]{1,99})\s*=\s*([A-Za-z_][\w-]{0,99})\s*(#.*)?", line)
    return f'; text must be in quotes: {found[1]} = "{found[2]}"' if found else ""
