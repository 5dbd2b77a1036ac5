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
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import jax

from lieint_jax import _checks
from lieint_jax._cache import use_program_cache
from lieint_jax._version import __version__
from lieint_jax.app import printer
from lieint_jax.app.printer import show

_EPILOG = """examples:
  lieint list                              all scenarios and studies, with their run times
  lieint list schemes                      what each scheme declares: its systems, conserved quantities, order
  lieint run toutatis                      800 days of a tumbling asteroid, 1000 members
  lieint run my.toml --members 100         your own scenario (copy lieint_jax/app/scenarios/toutatis.toml)
  lieint run toutatis --set order=4 --set 'state.angular_velocity_deg=[10, 0, 90]'   other values of its keys
  lieint run toutatis --out runs.zarr --members 100000   write to disk during the run; --resume continues it
  lieint run driven --set epoch=2024-03-01T12:00:00 --export attitude.aem   attitudes for other software
  lieint info runs.zarr                    describe that store
  lieint files satellite.oem body.obj      what files of other software are, and what can be done with them
  lieint plot runs.zarr                    report on that store and draw it
  lieint animate runs.zarr --out turn.html a rotating body, its axis and its momentum; also .gif and .mp4
  lieint study toutatis                    fit a spin state to the radar fixes of 1992, predict 2004 and 2008
  lieint study mine.py                     your own fit: see Fit my data in the documentation
  lieint check rigid_body                  what every scheme conserves of a free body, measured
  lieint check rigid_body --scheme cayley  the same, only for schemes with cayley in their name
  lieint check                             one example of each system: a few minutes the first time
  lieint check "SE(3)"                     what each map conserves on a matrix group
  lieint check --published                 numbers of other codes (NASA, Basilisk, …), recomputed
  lieint check groups                      energy and symplectic form, group by group and map by map
  lieint figure 1 2 3 --out figures        the paper's figures
"""

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


_Commands: TypeAlias = "argparse._SubParsersAction[_Parser]"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="lieint",
        description="Conserving integrators for Hamiltonian systems on Lie groups. Everything runs in float64.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(verbosity="normal", writes=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands)
    _add_results(commands)
    _add_others(commands)
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


def _add_run(commands: _Commands) -> None:
    run = commands.add_parser("run", help="integrate a scenario and report", description="Integrate a scenario.")
    run.set_defaults(command=_run, writes=True)
    add = run.add_argument
    add("scenario", metavar="SCENARIO", help="a shipped scenario (lieint list shows them) or a .toml file")
    about = "file of results: NAME.npz, written at the end with pictures next to it, or NAME.zarr, written during the "
    add("--out", type=_address, metavar="PATH", help=f"{about}run, which may be s3://BUCKET/NAME.zarr (gs://, az://)")
    about = "another value of a key, such as dt=0.1 or bodies.1.mass_kg=2e9 (KEY= removes it); may be repeated"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "write the run for other software too: .aem or .oem (CCSDS, the nominal member), .csv or .nc; may be "
    add("--export", type=Path, action="append", default=[], metavar="FILE", help=f"{about}repeated")
    add("--members", type=int, metavar="N", help="ensemble size, in place of the scenario's")
    add("--steps", type=int, metavar="N", help="number of steps, in place of the scenario's")
    add("--save-at", type=Path, metavar="FILE", help="save states at the times in FILE, one per line")
    add("--resume", action="store_true", help="continue the run in PATH.zarr; start it if there is none")
    add("--no-certificate", action="store_true", help="do not measure what the scheme conserves")
    add("--no-pictures", action="store_true", help="draw no pictures; lieint plot PATH draws them later")
    add("--devices", type=_positive, metavar="N", help="number of devices (default: all; CPU: one per core)")
    about = "run only part K = 0 ... N-1 of the members, as one of N independent processes that fill one NAME.zarr; "
    more = "auto: K and N of a job array (SLURM, AWS Batch, ...); auto/N where the array does not report N (Kubernetes)"
    add("--part", metavar="K/N", help=about + more)
    add("--parts", type=_positive, metavar="N", help="run N parts as tasks of a cluster, by --dask or --slurm")
    add("--dask", metavar="ADDRESS", help="with --parts: the Dask scheduler, such as tcp://HOST:8786")
    about = 'with --parts: write and submit an array of jobs with these options, as in --slurm="--time=4:00:00"'
    add("--slurm", metavar="OPTIONS", help=about)
    add("--any-machine", action="store_true", help="continue on another processor or JAX, whose last bits may differ")
    add("--distributed", action="store_true", help="run as one of the processes that srun or mpirun start")
    add("--coordinator", metavar="HOST:PORT", help="with --distributed and no srun: the first process")
    add("--processes", type=_positive, metavar="N", help="… the number of processes")
    add("--process", type=int, metavar="K", help="… the index of this process, from 0")


def _add_results(commands: _Commands) -> None:
    info = commands.add_parser("info", help="describe results", description="Describe a file of results.")
    info.set_defaults(command=_info)
    plot = commands.add_parser("plot", help="report on results and draw them", description="Report on results.")
    plot.set_defaults(command=_plot, writes=True)
    for reader in (info, plot):
        reader.add_argument("path", type=_address, metavar="PATH", help="NAME.npz, or NAME.zarr by its path or URL")
    plot.add_argument("--out", type=Path, metavar="DIR", help="folder of the pictures (default: that of PATH)")
    plot.add_argument("--force", action="store_true", help="replace existing pictures")
    plot.add_argument("--kind", default="", metavar="FILE.py:CLASS", help="the kind of its scenario, if it is your own")
    plot.add_argument("--study", type=Path, metavar="FILE", help="the FILE.py of your own study of which PATH is")
    animate = commands.add_parser("animate", help="rotating bodies as GIF, MP4 or HTML", description="Animate a run.")
    animate.set_defaults(command=_animate, writes=True)
    add = animate.add_argument
    add("path", type=Path, metavar="PATH", help="NAME.npz or NAME.zarr")
    add("--member", type=int, default=0, metavar="K", help="index of the member, from 0 (default 0)")
    add("--out", type=Path, metavar="FILE", help="NAME.gif (default, next to PATH), .mp4 or .html")
    add("--from", type=float, dest="first", metavar="T", help="time of the first frame (default: start)")
    add("--to", type=float, dest="last", metavar="T", help="time of the last frame (default: as far as is smooth)")
    add("--seconds", type=float, metavar="S", help="duration of the film (default 6; with --to as smooth, up to 30)")
    about = "shape of the body in the axes of its inertia: .obj, .stl, .ply, or .toml with [[parts]]; repeated for more"
    add("--shape", type=Path, action="append", default=[], metavar="FILE", help=about)
    add("--fps", type=_positive, default=20, metavar="F", help="frames per second (default 20)")
    add("--force", action="store_true", help="replace an existing file")


def _add_others(commands: _Commands) -> None:
    about = "List the scenarios and studies, or the schemes or systems of the library with their declared properties."
    shown = commands.add_parser("list", help="list scenarios and studies, schemes or systems", description=about)
    shown.set_defaults(command=_list)
    shown.add_argument("catalogue", nargs="?", choices=("schemes", "systems"), help="by default scenarios and studies")
    about = "Measure what each scheme conserves, system by system."
    check = commands.add_parser("check", help="print certificates", description=about)
    check.set_defaults(command=_check)
    about = "a module of systems (such as rigid_body), an example or a group; default: one example of each system"
    check.add_argument("system", nargs="?", default="", metavar="SYSTEM", help=about)
    check.add_argument("--all", action="store_true", help="check every example of every system: many minutes")
    check.add_argument("--scheme", default="", metavar="NAME", help="check only schemes whose name contains NAME")
    about = "length of a run (default 1000; 100 where Ad_q grows)"
    check.add_argument("--steps", type=_positive, metavar="N", help=about)
    check.add_argument("--published", action="store_true", help="recompute published numbers of other codes instead")
    about = "Describe files that other software wrote: orbits, attitudes, shapes, molecules, light curves, logs."
    given = commands.add_parser("files", help="describe files of other software", description=about)
    given.set_defaults(command=_files)
    given.add_argument("paths", nargs="+", type=Path, metavar="FILE", help="an OEM, a TLE, an OBJ, a CSV, …")
    about = "Write figures as PNG and PDF."
    figure = commands.add_parser("figure", help="recompute figures of the paper", description=about)
    figure.set_defaults(command=_figure, writes=True)
    about = "numbers in the paper, 1 to 5, or showtop: the tips of the body axes, of Appendix A"
    figure.add_argument("figures", nargs="+", metavar="N", help=about)
    study = commands.add_parser("study", help="fit parameters, learn κ, measure chaos", description="Run a study.")
    study.set_defaults(command=_study, writes=True)
    study.add_argument("name", metavar="NAME", help="a study that lieint list shows, or your own file NAME.py")
    about = "folder to write to (default: here)"
    for writer in (figure, study):
        writer.add_argument("--out", type=Path, default=Path(), metavar="DIR", help=about)
    study.add_argument("--quick", action="store_true", help="run a small version of the study")
    schema = commands.add_parser("schema", help="the keys of scenario files, as a JSON schema", description="A schema.")
    schema.set_defaults(command=_schema)


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
    from lieint_jax import ensemble
    from lieint_jax.app.command import cluster, run
    from lieint_jax.app.command import list as listing
    from lieint_jax.runs import processes

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
        part = ensemble.part_of_text(options.part)
    default = options.members is None and options.steps is None and not options.set
    if default and not options.distributed:
        listing.announce(f"run {options.scenario}")
    if options.devices or not options.distributed:
        ensemble.want_devices(options.devices)
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

    show(listing.text(options.catalogue))


def _info(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import info, study

    show((study.info if study.is_study_file(options.path) else info.contents)(options.path))


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
    animate(options.path, options.out, options.member, options.seconds, options.fps, options.force, span, options.shape)


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

    show("\n".join(map(files.describe, options.paths)))


def _figure(options: argparse.Namespace) -> None:
    from lieint_jax.app import plots
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command.figures import FIGURES

    unknown = [n for n in options.figures if n not in FIGURES]
    if unknown:
        every = " ".join(sorted(FIGURES))
        raise ValueError(f"figure {unknown[0]} is not one of those recomputed; lieint figure {every} draws them all")
    options.out.mkdir(parents=True, exist_ok=True)
    for n in options.figures:
        listing.announce(f"figure {n}")
        show(FIGURES[n](options.out))
        printer.show_written(*plots.files(options.out / f"figure-{n}.png"))


def _study(options: argparse.Namespace) -> None:
    from lieint_jax import ensemble
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command import study

    ensemble.want_devices(None)
    if not options.quick:
        listing.announce(f"study {options.name}")
    study.run(options.name, options.out, options.quick)


if __name__ == "__main__":
    sys.exit(main())
