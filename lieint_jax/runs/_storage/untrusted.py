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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lieint_jax import _checks
from lieint_jax.runs._storage.storage import ROOT, Address

NAME = re.compile(r"(?!\.)[^/\\\x00-\x1f\x7f-\x9f]+")  # of a file or an array in a store
_JSON_BYTES, _JSON_DEPTH = 2**26, 64  # the most of a description
_REASON = 1000  # characters of a reason in a message


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
        named = path.with_suffix(".zarr") if path.name else "NAME.zarr"
        raise UnreadableError(f"there is no file {path}; lieint run NAME --out {named} writes one") from None
    except ValueError as error:  # a null character
        raise UnreadableError(f"{str(path)!r} is not the name of a file: {error}") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnreadableError(f"{path} is a device, a pipe or a socket; give a folder NAME.zarr or a file NAME.zip")


def check_size(name: str, size: int) -> None:
    """Raise ValueError if a file of metadata has more bytes than that of any run."""
    if name.endswith(ROOT) and size > _JSON_BYTES:
        raise ValueError(f"{name} has {_checks.spoken_size(size)}")


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text of bounded size and depth."""
    if len(text) > _JSON_BYTES:
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
