"""The command `lieint`: it finds the function of a command, whose signature makes its options, and calls it."""

from __future__ import annotations

import codecs
import contextlib
import difflib
import functools
import importlib
import importlib.metadata
import io
import platform
import re
import sys
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import tyro

from lieint_jax import _checks
from lieint_jax._cache import use_program_cache
from lieint_jax._version import __version__
from lieint_jax.command.printer import show
from lieint_jax.command.scripts import ScriptError

COMMANDS = {  # their functions; a command imports what it needs only
    "run": "run.run",
    "list": "listing.print_list",
    "check": "check.check",
    "files": "files.describe",
    "info": "info.describe",
    "plot": "plot.plot",
    "animate": "animate.animate",
}
_EXAMPLES = """
examples:
  lieint list                              all examples, with their run times
  lieint run toutatis                      800 days of a tumbling asteroid, 1000 members
  lieint run toutatis --help               what can be varied, with units and defaults
  lieint list toutatis > mine.py           the script of that example, to copy and change
  lieint run mine.py --members 100         your own script: any file with a function main
  lieint run toutatis --members 100000 --out runs.zarr    --resume continues it after an interrupt
  lieint info runs.zarr                    describe that store
  lieint plot runs.zarr                    report on that store and draw it
  lieint animate runs.zarr --out turn.html a rotating body, its axis and its momentum; also .gif and .mp4
  lieint files satellite.oem body.obj      what files of other software are, and what can be done with them
  lieint list schemes                      what each scheme declares: its systems, conserved quantities, order
  lieint check rigid_body                  what every scheme conserves of a free body, measured
  lieint check "SE(3)"                     what each map conserves on a matrix group
  lieint check --published                 numbers of other codes (NASA, Basilisk, …), recomputed
"""
_NAME, _MESSAGE = 100, 4000  # largest number of characters of a file's name in a message, and of a message
_PLAIN = {"·": "*", "×": "x", "÷": "/", "−": "-", "–": "-", "—": "-", "→": "->", "↦": "->"}
_PLAIN |= {"≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "°": "deg", "‖": "||", "½": "1/2"}


class _WrongOptionError(ValueError):
    """A command line that cannot be read."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code.

    It is 0 on success; 2 with one line on stderr for an error that the user can correct; 1 for an error in a script,
    with the traceback from its own line, and for a closed pipe; 130 after an interrupt.
    """
    _print_in_any_encoding()
    jax.config.update("jax_enable_x64", True)
    use_program_cache()
    warnings.showwarning = _show_once()
    try:
        call = _read(list(sys.argv[1:] if arguments is None else arguments))
        if call is not None:
            call()
    except BrokenPipeError:  # the reader of our output has stopped, as in `lieint … | head`
        sys.stderr.close()
        return 1
    except ScriptError as failed:
        show("".join(traceback.format_exception(failed.error)).rstrip(), error=True)
        return 1
    except (ValueError, OSError, MemoryError) as error:
        show(f"lieint: {_sentence(error)}", error=True)
        return 2
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        show(f"lieint: {_sentence(MemoryError())}", error=True)
        return 2
    except KeyboardInterrupt as stop:
        show(f"lieint: {stop if str(stop) else 'interrupted'}", error=True)
        return 130
    return 0


def _read(words: list[str]) -> Callable[[], None] | None:
    """The call that a command line asks for; None if it asked for help, which is printed.

    Raises:
        _WrongOptionError: there is no such command, or it has no such options.
    """
    if words and words[0] == "--version":
        jax_version = importlib.metadata.version("jax")
        show(f"lieint_jax {__version__}, jax {jax_version}, python {platform.python_version()}")
        return None
    if words and words[0] in ("-h", "--help"):
        show(_help())
        return None
    if not words or words[0] not in COMMANDS:
        if not words:
            raise _WrongOptionError("give a command; see lieint --help")
        near = difflib.get_close_matches(words[0], COMMANDS, 1, 0.5)
        meant = f"did you mean {near[0]}? " if near else ""
        raise _WrongOptionError(f"there is no command {words[0]!r}: {meant}See lieint --help")
    name, *options = words
    command = _function(name)
    if name != "run":
        return _options(command, f"lieint {name}", options)
    if not options or options[0].startswith("-"):
        if {"-h", "--help"} & set(options):
            show(importlib.import_module(command.__module__).USAGE)
            return None
        raise _WrongOptionError("give the script: lieint run NAME or FILE.py, and after it its options")
    return functools.partial(command, options[0], options[1:], _options)


def _function(command: str) -> Callable[..., None]:
    """The function of a command."""
    module, _, name = COMMANDS[command].partition(".")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)


def _options(function: Callable[..., None], name: str, words: Sequence[str]) -> Any:
    """The call of a function with the options in `words`, which tyro makes from its signature and its docstring."""

    @functools.wraps(function)
    def later(*args: Any, **kwargs: Any) -> Any:
        return functools.partial(function, *args, **kwargs)

    settings = (tyro.conf.DisallowNone,)  # `--out None` is of no use
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(later, prog=name, args=words, config=settings)
    except SystemExit as stop:
        if not stop.code:  # it was --help
            return None
        raise _WrongOptionError(f"{_message(said.getvalue())} See {name} --help") from None


def _message(box: str) -> str:
    """The message in a box that tyro has drawn, from its title, or a rule below that, to the next rule."""
    lines = [line.strip("│╭╮╰╯|+ ") for line in box.splitlines()[1:]]  # a terminal without Unicode has the plain ones
    rules = [set(line) <= set("─-") for line in lines]
    first = 1 if rules[:1] == [True] else 0
    until = rules.index(True, first) if True in rules[first:] else len(lines)
    text = " ".join(lines[first:until]).removesuffix(".")
    if "Perhaps you meant:" in lines and (near := re.search(r"--[a-z][\w-]*", " ".join(lines[until:]))):
        text += f"; did you mean {near[0]}?"
    return text if text.endswith("?") else f"{text}."


def _help() -> str:
    about = [f"  {name:<10}{(_function(name).__doc__ or '').splitlines()[0]}" for name in COMMANDS]
    head = "usage: lieint COMMAND …; lieint COMMAND --help has its options; lieint --version has the versions"
    title = "Conserving integrators for Hamiltonian systems on Lie groups. Everything runs in float64."
    return "\n".join([head, "", title, "", *about, _EXAMPLES]).rstrip()


def _show_once() -> Callable[..., None]:
    """A function that shows a warning, unless it has shown the same text."""
    known: set[str] = set()

    def show_warning(message: Warning | str, *_: object, **__: object) -> None:
        if str(message) not in known:
            known.add(str(message))
            show(f"lieint: warning: {_checks.printable(str(message), _MESSAGE)}", error=True)

    return show_warning


def _sentence(error: Exception) -> str:
    """The message of an error in one line."""
    if isinstance(error, MemoryError):
        return f"not enough memory: {str(error) or 'use fewer members or a larger save_every'}"
    if isinstance(error, OSError) and error.strerror:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        short = [_checks.printable(name, _NAME) for name in names]
        return ": ".join([" → ".join(short), error.strerror] if short else [error.strerror])
    return _checks.printable(" ".join(str(error).split("\n")), _MESSAGE)


def _print_in_any_encoding() -> None:
    """Let stdout and stderr write ASCII in place of the characters that their encoding lacks."""
    codecs.register_error("lieint", _encode_error_in_ascii)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="lieint")


def _encode_error_in_ascii(error: UnicodeError) -> tuple[str, int]:
    """The ASCII text in place of characters that cannot be encoded, and the index of the next character."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(map(_spell_in_ascii, error.object[error.start : error.end])), error.end


def _spell_in_ascii(character: str) -> str:
    """The ASCII spelling of a character: "pi" for π, "..." for …, "?" if there is none."""
    name = unicodedata.name(character, "")
    if name.startswith("GREEK "):
        letter = name.split()[-1]
        return letter.capitalize() if "CAPITAL" in name else letter.lower()
    return _PLAIN.get(character) or unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"


if __name__ == "__main__":
    sys.exit(main())
