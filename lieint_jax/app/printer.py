"""The way to the terminal: the application prints by `show`, and texts of files pass `readable`."""

from __future__ import annotations

import logging
import sys
import time
from typing import Any, Literal, TypeAlias

from lieint_jax import _checks

Verbosity: TypeAlias = Literal["quiet", "normal", "verbose"]
_PROSE = 500  # characters of a text in a report
_LEVELS = {"quiet": logging.ERROR, "normal": logging.WARNING, "verbose": logging.INFO}


class _Log(logging.Handler):
    """Prints the log of the package on stderr, and the times of phases."""

    verbosity: Verbosity = "normal"
    last: float = 0.0  # the time at which the last phase ended

    def emit(self, record: logging.LogRecord) -> None:
        show(f"lieint: {record.getMessage()}", error=True)


_log = _Log()


def choose(verbosity: Verbosity) -> None:
    """Choose what is printed: normally all but the times of phases and the log of engines, which "verbose" adds.

    "quiet" prints errors, warnings and the paths of written files only.
    """
    _log.verbosity, _log.last = verbosity, time.perf_counter()
    package = logging.getLogger(__name__.partition(".")[0])
    package.setLevel(_LEVELS[verbosity])
    package.addHandler(_log)  # once: a logger has each handler once


def show(*lines: object, error: bool = False, always: bool = False) -> None:
    """Print lines on stdout or stderr, control characters escaped. If quiet, only errors and what is `always` shown."""
    if error or always or _log.verbosity != "quiet":
        text = _checks.printable("\n".join(map(str, lines)), sys.maxsize, keep="\n")
        stream = sys.stderr if error else sys.stdout
        if stream is not None:  # else it is closed, and print would write an error to stdout
            print(text, file=stream, flush=True)


def show_written(*paths: object, about: str = "") -> None:
    """Print the paths of the files that a command has written, and what the first one holds; if quiet, one per line."""
    if _log.verbosity == "quiet":
        show(*paths, always=True)
    else:
        first, *others = map(str, paths)
        show(f"\nwritten: {', '.join([f'{first} ({about})' if about else first, *others])}")


def show_time(phase: str) -> None:
    """If verbose, print the time since the last phase ended."""
    last, _log.last = _log.last, time.perf_counter()
    if _log.verbosity == "verbose":
        show(f"lieint: {phase}: {_log.last - last:.2f} s", error=True)


def readable(tree: Any, most: int = _PROSE) -> Any:
    """A tree of tables, lists and scenarios with texts that can be printed: escaped, each on one line and cut."""
    match tree:
        case str():
            return _checks.printable(tree, most)
        case dict():
            return {readable(key, most): readable(value, most) for key, value in tree.items()}
        case list():
            return [readable(value, most) for value in tree]
        case object(model_copy=copied, model_extra=extra):  # of pydantic, which is not imported here
            fields = {**vars(tree), **(extra or {})}
            return copied(update={name: readable(value, most) for name, value in fields.items()})
    return tree
