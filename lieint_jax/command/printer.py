"""The way to the terminal: the command prints by `show`, with control characters of foreign texts escaped."""

from __future__ import annotations

import sys

from lieint_jax import _checks


def show(*lines: object, error: bool = False) -> None:
    """Print lines on stdout or stderr, control characters escaped."""
    text = _checks.printable("\n".join(map(str, lines)), sys.maxsize, keep="\n")
    stream = sys.stderr if error else sys.stdout
    if stream is not None:  # else it is closed, and print would write an error to stdout
        print(text, file=stream, flush=True)


def show_written(*paths: object, about: str = "") -> None:
    """Print the paths of the files that a command has written, and what the first one holds."""
    first, *others = map(str, paths)
    show(f"\nwritten: {', '.join([f'{first} ({about})' if about else first, *others])}")
