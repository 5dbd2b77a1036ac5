"""The command `lieint`: it parses its arguments and calls the package."""

from __future__ import annotations

import argparse
import codecs
import contextlib
import importlib.metadata
import io
import platform
import sys
import threading
import tomllib
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax

from lieint_jax import _checks
from lieint_jax._cache import use_program_cache
from lieint_jax._version import __version__
from lieint_jax.app import printer
from lieint_jax.app.printer import show

_VERBOSITIES = {
    "quiet": "of a command that writes files: print errors, warnings and the paths of these files only",
    "verbose": "print which engine runs the steps, machine code or XLA, and why, and the times of phases, on stderr",
}
_NAME, _MESSAGE = 100, 4000  # largest number of characters of a file's name in a message, and of a message
_WAIT = 5.0  # seconds of silence while the processes of a run connect
_PLAIN = {"·": "*", "×": "x", "÷": "/", "−": "-", "–": "-", "—": "-", "→": "->", "↦": "->"}
_PLAIN |= {"≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "°": "deg", "‖": "||", "½": "1/2"}


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 0 on success, 2 with one line on stderr for an error that the user can correct."""
    _print_in_any_encoding()
    options = _parser().parse_args(arguments)
    printer.choose(options.verbosity if options.writes or options.verbosity != "quiet" else "normal")
    jax.config.update("jax_enable_x64", True)
    use_program_cache()
    warnings.showwarning = _show_once()
    try:
        options.command(options)
    except BrokenPipeError:  # the reader of our output has stopped, as in `lieint … | head`
        sys.stderr.close()
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


def _show_once() -> Callable[..., None]:
    """A function that shows a warning, unless it has shown the same text: a scenario's numbers are checked twice."""
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


class _Parser(argparse.ArgumentParser):
    """A parser whose errors end with the command that prints help; so do the parsers of its subcommands."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"lieint: {_checks.printable(message, _MESSAGE)}; see {self.prog} --help\n")


def _address(text: str) -> Any:
    """The path or URL of results, from the command line."""
    if "://" not in text:
        return Path(text)
    from lieint_jax.runs import store as archives

    try:
        return archives.address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _positive(text: str) -> int:
    """A positive integer, from the command line."""
    if not text.strip().isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive integer")
    return int(text)


def _run(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import cluster, run
    from lieint_jax.app.command import list as listing
    from lieint_jax.runs import part_of_text, processes, want_devices

    group = (options.coordinator, options.processes, options.process)
    if not options.distributed and any(x is not None for x in group):
        raise ValueError("--coordinator, --processes and --process require --distributed")
    if options.parts or options.dask is not None or options.slurm is not None:
        cluster.check(options)
    if options.slurm is not None:
        cluster.slurm(options)
        return
    part = None
    if options.part is not None:
        if options.distributed:
            raise ValueError("--part is for independent processes, --distributed for processes that start together")
        part = part_of_text(options.part)
    default = options.members is None and options.steps is None and not options.set
    if default and not options.distributed:
        listing.announce(f"run {options.scenario}")
    if options.devices or not options.distributed:
        want_devices(options.devices)
    if options.distributed:
        where = f" at {options.coordinator}, {options.processes} in all," if options.coordinator else ""
        with _report_waiting(f"waiting for the processes of this run{where} to connect"):
            processes.initialize(*group)
    same = ("out", "members", "steps", "devices", "resume", "save_at", "parts")
    given: dict[str, Any] = {name: vars(options)[name] for name in same}
    given |= {"certificate": not options.no_certificate, "pictures": not options.no_pictures, "given": options.set}
    given |= {"part": part, "exports": options.export, "same_bits": not options.any_machine}
    try:
        with contextlib.nullcontext() if options.dask is None else cluster.dask(options.dask) as executor:
            run.run(options.scenario, **given, executor=executor)
    except processes.LostProcess as error:
        processes.leave(f"lieint: {error}")


@contextlib.contextmanager
def _report_waiting(what: str) -> Iterator[None]:
    """Report on stderr what is being waited for, if this context lasts longer than `_WAIT`."""
    timer = threading.Timer(_WAIT, lambda: show(f"lieint: {what} …", error=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _list(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import list as listing

    show(listing.text(options.name))


def _info(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import info, study

    is_study = study.is_study_file(options.path)
    show(study.info(options.path) if is_study else info.describe(options.path, options.kind))


def _plot(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import info, study

    if study.is_study_file(options.path):
        study.plot(options.path, options.out, options.force, options.study)
    elif options.study is not None:
        raise ValueError(f"{options.path} holds no results of a study: leave out --study")
    else:
        info.plot(options.path, options.out, options.force, options.kind)


def _animate(options: argparse.Namespace) -> None:
    from lieint_jax.app.command.animate import animate

    span = (options.first, options.last)
    named = ("out", "member", "seconds", "fps", "force")
    given = {name: vars(options)[name] for name in named}
    animate(options.path, **given, span=span, shapes=options.shape, own_kind=options.kind)


def _schema(_: argparse.Namespace) -> None:
    import json

    from lieint_jax.app import scenarios

    show(json.dumps(scenarios.schema(), indent=1, ensure_ascii=False))


def _check(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import check
    from lieint_jax.app.command import list as listing

    if options.published:
        if options.system or options.scheme or options.steps or options.all:
            raise ValueError("--published has its own cases: type lieint check --published without other arguments")
        check.check_published()
        return
    if options.all and options.system:
        raise ValueError(f"--all checks every system: type lieint check --all, or lieint check {options.system}")
    if not options.scheme and options.steps is None and not options.all:
        listing.announce(f"check {options.system}".strip())
    check.check(options.system, options.scheme, options.steps, options.all)


def _files(options: argparse.Namespace) -> None:
    from lieint_jax import files

    for path in options.paths:  # one by one: an error leaves those before it on the screen
        show(files.describe(path))


def _figure(options: argparse.Namespace) -> None:
    from lieint_jax import plots
    from lieint_jax.app.command import files
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command.figures import FIGURES

    unknown = [n for n in options.figures if n not in FIGURES]
    if unknown:
        every = " ".join(sorted(FIGURES))
        raise ValueError(f"figure {unknown[0]} is not one of those recomputed; lieint figure {every} draws them all")
    files.make_folder(options.out)
    for n in options.figures:
        listing.announce(f"figure {n}")
        show(FIGURES[n](options.out))
        printer.show_written(*plots.files(options.out / f"figure-{n}.png"))


def _study(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command import study
    from lieint_jax.runs import want_devices

    want_devices(None)
    if not options.quick:
        listing.announce(f"study {options.name}")
    study.run(options.name, options.out, options.quick)


_COMMANDS = {"run": _run, "info": _info, "plot": _plot, "animate": _animate, "list": _list, "check": _check}
_COMMANDS |= {"files": _files, "figure": _figure, "study": _study, "schema": _schema}
_TYPES = {"int": int, "float": float, "path": Path, "address": _address, "positive": _positive}


def _parser() -> argparse.ArgumentParser:
    """The parser of the commands in `commands.toml`."""
    table = tomllib.loads(Path(__file__).with_name("commands.toml").read_text(encoding="utf-8"))
    parser = _Parser(
        prog="lieint",
        description="Conserving integrators for Hamiltonian systems on Lie groups. Everything runs in float64.",
        epilog=table["epilog"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(verbosity="normal", writes=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, about in table["commands"].items():
        command = commands.add_parser(name, help=about["help"], description=about["description"])
        command.set_defaults(command=_COMMANDS[name], **{"writes": True} if "writes" in about else {})
        for argument, options in about.get("arguments", {}).items():
            typed = {"type": _TYPES[options["type"]]} if "type" in options else {}
            command.add_argument(argument, **options | typed)
    for each in (parser, *commands.choices.values()):
        _add_common_options(each)
    return parser


def _add_common_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that are accepted before and after the name of every command."""
    versions = f"lieint_jax {__version__}, jax {importlib.metadata.version('jax')}, python {platform.python_version()}"
    parser.add_argument("--version", action="version", version=versions, help="print the versions, and exit")
    add = parser.add_mutually_exclusive_group().add_argument
    for name, about in _VERBOSITIES.items():
        names, omitted = (f"-{name[0]}", f"--{name}"), argparse.SUPPRESS
        add(*names, dest="verbosity", action="store_const", const=name, default=omitted, help=about)


if __name__ == "__main__":
    sys.exit(main())
