"""Text files that people bring: their lines with numbers, and one sentence about whatever is wrong with one."""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from lieint_jax import _checks

_BYTES = 2**28  # the most of a file: 256 MiB
_EXPONENT = r"([eEdD]|\*\^)"  # of Fortran and of Mathematica, too
_NUMBER = re.compile(rf"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)({_EXPONENT}[+-]?[0-9]+)?")


class Text:
    """The lines of a text file, or of a text in memory, and the errors that name file and line.

    Attributes:
        name: what messages call it: the path, or a word for a text in memory, as text for a terminal.
        lines: its lines without their ends, the first being number 1 in messages.
    """

    def __init__(self, name: str, lines: list[str]) -> None:
        self.name, self.lines = _checks.path_text(name), lines

    def fail(self, line: int, what: str) -> NoReturn:
        """Raise the ValueError that `line`, counted from 1, is wrong: "NAME, line 3: what"; 0 means the whole file."""
        place = f"{self.name}, line {line}" if line else self.name
        raise ValueError(f"{place}: {what}")

    def number(self, line: int, word: str, what: str) -> float:
        """The finite number of a word, with an exponent of e, D or *^; `what` names it in the message."""
        if not _NUMBER.fullmatch(word.strip()):
            self.fail(line, f"{what} must be a finite number, got {_checks.printable(word)!r}")
        value = float(re.sub(_EXPONENT, "e", word.strip()))
        if not math.isfinite(value):
            self.fail(line, f"{what} must be a finite number, got {_checks.printable(word)!r}")
        return value

    def numbers(self, line: int, words: Iterable[str], what: str) -> list[float]:
        """The finite numbers of words."""
        return [self.number(line, word, what) for word in words]


def read_text(path: str | Path) -> Text:
    """The lines of a text file, unpacked if its name ends in .gz: UTF-8, with or without a byte order mark.

    Lines end in LF, CRLF or CR.

    Raises:
        ValueError: no ordinary file, more than 256 MiB, or no text.
    """
    return decode(str(path), read_bytes(path))


def read_bytes(path: str | Path, head: int | None = None) -> bytes:
    """The bytes of an ordinary file, or its first `head` ones, unpacked if it ends in .gz; errors as in `read_text`."""
    place, shown = Path(path), _checks.path_text(path)
    if not place.is_file():
        raise ValueError(f"there is no file {shown}" if not place.exists() else f"{shown} is no ordinary file")
    try:
        with gzip.open(place) if place.suffix == ".gz" else place.open("rb") as stream:
            data = stream.read(_BYTES + 1 if head is None else head)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ValueError(f"{shown} is damaged, its compressed data cannot be read: {error}") from error
    if len(data) > _BYTES:
        raise ValueError(f"{shown} has more than {_checks.spoken_size(_BYTES)}, too much for a file of text")
    return data


def decode(name: str, data: bytes) -> Text:
    """The lines of these bytes; `name` names them in messages."""
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{_checks.path_text(name)} is not UTF-8 text: {error}") from error
    if "\0" in text:
        raise ValueError(f"{_checks.path_text(name)} is no text: it has a null character")
    return Text(name, re.split(r"\r\n|\n|\r", text))
