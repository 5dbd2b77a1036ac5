"""The command `lieint`: parses its arguments and calls the package."""

from __future__ import annotations

import argparse
import codecs
import contextlib
import io
import sys
import threading
import unicodedata
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

_EPILOG = """examples:
  lieint list                              all scenarios and studies, and how long each takes
  lieint run toutatis                      800 days of a tumbling asteroid, 1000 members
  lieint run my.toml --members 100         your own scenario (copy lieint_jax/app/scenarios/toutatis.toml)
  lieint run toutatis --out runs.zarr --members 100000   to disk while it runs; with --resume it goes on
  lieint info runs.zarr                    describe that store
  lieint plot runs.zarr                    report on it and draw it
  lieint animate runs.zarr --out turn.html a turning body, its axis and its momentum; also .gif and .mp4
  lieint study toutatis                    fit a spin state to the radar fixes of 1992, predict 2004 and 2008
  lieint check rigid_body                  what every scheme conserves of a free body, measured
  lieint check rigid_body --scheme cayley  one of them
  lieint check                             of one example of each system: some minutes the first time
  lieint check "SE(3)"                     what is conserved on a matrix group, by which map
  lieint check --published                 numbers of other codes (NASA, Basilisk, …), recomputed
  lieint check groups                      energy and symplectic form, group by group and map by map
  lieint figure 1 2 3 --out figures        the paper's figures
"""

_NAME = 100  # the most characters of a file's name in a message
_WAIT = 5.0  # seconds of silence while the processes of a run connect
_PLAIN = {"·": "*", "×": "x", "÷": "/", "−": "-", "–": "-", "—": "-", "→": "->", "↦": "->"}
_PLAIN |= {"≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "°": "deg", "‖": "||", "½": "1/2"}


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 0 on success, 2 with one line on stderr for an error that the user can correct."""
    _print_everywhere()
    options = _parser().parse_args(arguments)
    import jax

    from lieint_jax.app.command.compilation import keep_programs

    jax.config.update("jax_enable_x64", True)
    keep_programs()
    warnings.showwarning = lambda message, *_, **__: print(f"lieint: warning: {message}", file=sys.stderr)
    try:
        options.command(options)
    except BrokenPipeError:  # the reader of our output has stopped, as in `lieint … | head`
        sys.stderr.close()
        return 1
    except (ValueError, OSError, MemoryError) as error:
        print(f"lieint: {_sentence(error)}", file=sys.stderr)
        return 2
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(f"lieint: {_sentence(MemoryError())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(f"lieint: {stop if str(stop) else 'interrupted'}", file=sys.stderr)
        return 130
    return 0


def _sentence(error: Exception) -> str:
    """The message of an error in one line."""
    if isinstance(error, MemoryError):
        return f"not enough memory: {str(error) or 'fewer members, or a larger save_every, need less'}"
    if isinstance(error, OSError) and error.strerror:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        short = [name if len(name) <= _NAME else f"{name[:_NAME]}…" for name in names]
        return ": ".join([" → ".join(short), error.strerror] if short else [error.strerror])
    return " ".join(str(error).split("\n"))


def _print_everywhere() -> None:
    """Print to terminals and files of any encoding: what one does not have is written in plain letters."""
    codecs.register_error("lieint", _spelled)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="lieint")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """What is printed in place of characters that cannot be encoded, and where printing goes on."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(map(_plain, error.object[error.start : error.end])), error.end


def _plain(character: str) -> str:
    """A character in ASCII: "pi" of π, "..." of …, "?" of what has no like."""
    name = unicodedata.name(character, "")
    if name.startswith("GREEK "):
        letter = name.split()[-1]
        return letter.capitalize() if "CAPITAL" in name else letter.lower()
    return _PLAIN.get(character) or unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"


class _Parser(argparse.ArgumentParser):
    """A parser whose errors end with what to type; the parsers of the commands are of its class too."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"lieint: {message}; {self.prog} --help says more\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="lieint",
        description="Conserving integrators for Hamiltonian systems on Lie groups. Everything runs in float64.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands)
    _add_list(commands)
    _add_results(commands)
    _add_check(commands)
    _add_paper(commands)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser("run", help="integrate a scenario and report", description="Integrate a scenario.")
    run.add_argument("scenario", metavar="SCENARIO", help="a shipped scenario (lieint list shows them) or a .toml file")
    run.add_argument(
        "--out",
        type=_address,
        metavar="PATH",
        help="where to write results: NAME.npz at the end, with pictures beside it, or NAME.zarr while the run goes "
        "on, which may be s3://BUCKET/NAME.zarr (gs://, az://)",
    )
    run.add_argument("--members", type=int, metavar="N", help="ensemble size, in place of the scenario's")
    run.add_argument("--steps", type=int, metavar="N", help="number of steps, in place of the scenario's")
    run.add_argument("--save-at", type=Path, metavar="FILE", help="save states at the times in FILE, one a line")
    run.add_argument("--resume", action="store_true", help="go on with the run in PATH.zarr; start it if there is none")
    run.add_argument("--no-certificate", action="store_true", help="do not measure what the scheme conserves")
    run.add_argument("--no-pictures", action="store_true", help="draw none; lieint plot PATH draws them later")
    run.add_argument("--devices", type=_positive, metavar="N", help="devices to use; on a CPU, if not told, one a core")
    run.add_argument(
        "--part",
        metavar="K/N",
        help="only part K = 0 ... N-1 of the members, one of N independent processes that fill one NAME.zarr; auto: "
        "the task of a job array (SLURM, AWS Batch, ...); auto/N where the array does not report N (Kubernetes)",
    )
    run.add_argument("--distributed", action="store_true", help="one of many processes, as srun or mpirun start them")
    run.add_argument("--coordinator", metavar="HOST:PORT", help="with --distributed and no srun: the first process")
    run.add_argument("--processes", type=_positive, metavar="N", help="… how many there are")
    run.add_argument("--process", type=int, metavar="K", help="… which this one is, from 0")
    run.set_defaults(command=_run)


def _add_list(commands: Any) -> None:
    shown = commands.add_parser("list", help="scenarios and studies, and how long each takes", description="A list.")
    shown.set_defaults(command=_list)


def _add_results(commands: Any) -> None:
    info = commands.add_parser("info", help="what a file of results holds", description="Look into results.")
    info.add_argument("path", type=_address, metavar="PATH", help="NAME.npz, or NAME.zarr by its path or URL")
    info.set_defaults(command=_info)
    plot = commands.add_parser("plot", help="report on results and draw them", description="Pictures of results.")
    plot.add_argument("path", type=_address, metavar="PATH", help="NAME.npz, or NAME.zarr by its path or URL")
    plot.add_argument("--out", type=Path, metavar="DIR", help="folder of the pictures (default: that of PATH)")
    plot.add_argument("--force", action="store_true", help="replace pictures that exist")
    plot.set_defaults(command=_plot)
    animate = commands.add_parser("animate", help="turning bodies as GIF, MP4 or HTML", description="A moving picture.")
    animate.add_argument("path", type=Path, metavar="PATH")
    animate.add_argument("--member", type=int, default=0, metavar="K", help="which member, from 0 (default 0)")
    animate.add_argument("--out", type=Path, metavar="FILE", help="NAME.gif (default, beside PATH), .mp4 or .html")
    animate.add_argument("--from", type=float, dest="first", metavar="T", help="time of the first frame (default: all)")
    animate.add_argument("--to", type=float, dest="last", metavar="T", help="time of the last frame, if it fits")
    animate.add_argument("--seconds", type=float, default=6.0, metavar="S", help="how long it lasts (default 6)")
    animate.add_argument("--fps", type=_positive, default=20, metavar="F", help="frames a second (default 20)")
    animate.add_argument("--force", action="store_true", help="replace a file that exists")
    animate.set_defaults(command=_animate)
    schema = commands.add_parser("schema", help="the keys of scenario files, as a JSON schema", description="Keys.")
    schema.set_defaults(command=_schema)


def _add_check(commands: Any) -> None:
    check = commands.add_parser(
        "check", help="print certificates", description="Measure what each scheme conserves, system by system."
    )
    check.add_argument(
        "system",
        nargs="?",
        default="",
        metavar="SYSTEM",
        help="a system module (rigid_body for one), example, or group; default: one example of each system",
    )
    check.add_argument("--all", action="store_true", help="every example of every system: many minutes")
    check.add_argument("--scheme", default="", metavar="NAME", help="only schemes whose name contains NAME")
    check.add_argument(
        "--steps", type=_positive, metavar="N", help="length of a run (default 1000; 100 where Ad_q grows)"
    )
    check.add_argument("--published", action="store_true", help="recompute published numbers of other codes instead")
    check.set_defaults(command=_check)


def _add_paper(commands: Any) -> None:
    figure = commands.add_parser(
        "figure", help="recompute figures of the paper", description="Write figures as PNG and PDF."
    )
    figure.add_argument("numbers", nargs="+", type=int, metavar="N", help="numbers in the paper: 1 to 5")
    figure.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder to write to (default: here)")
    figure.set_defaults(command=_figure)
    study = commands.add_parser("study", help="fit parameters, learn κ, measure chaos", description="Run a study.")
    study.add_argument("name", metavar="NAME", help="one of those that lieint list shows")
    study.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder to write to (default: here)")
    study.add_argument("--quick", action="store_true", help="a small one")
    study.set_defaults(command=_study)


def _address(text: str) -> Any:
    """The path or URL of results."""
    if "://" not in text:
        return Path(text)
    from lieint_jax.ensemble import archives

    try:
        return archives.address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a positive number")
    return value


def _run(options: argparse.Namespace) -> None:
    from lieint_jax import ensemble
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command import run
    from lieint_jax.ensemble import processes

    apart = (options.coordinator, options.processes, options.process)
    if not options.distributed and any(x is not None for x in apart):
        raise ValueError("--coordinator, --processes and --process go with --distributed")
    part = None
    if options.part is not None:
        if options.distributed:
            raise ValueError("--part is for independent processes, --distributed for those that start together")
        part = ensemble.part_of_text(options.part)
    if options.members is None and options.steps is None and not options.distributed:
        listing.announce(f"run {options.scenario}")
    if options.devices or not options.distributed:
        ensemble.want_devices(options.devices)
    if options.distributed:
        with _announced(f"waiting for the processes of this run{_where(options)} to connect"):
            processes.initialize(*apart)
    try:
        run.run(
            options.scenario,
            options.out,
            options.members,
            options.steps,
            options.devices,
            options.resume,
            options.save_at,
            certificate=not options.no_certificate,
            pictures=not options.no_pictures,
            part=part,
        )
    except processes.LostProcess as error:
        processes.leave(f"lieint: {error}")


def _where(options: argparse.Namespace) -> str:
    return f" at {options.coordinator}, {options.processes} in all," if options.coordinator else ""


@contextlib.contextmanager
def _announced(what: str) -> Iterator[None]:
    """A context that reports on stderr what is being waited for, if that lasts longer than `_WAIT`."""
    timer = threading.Timer(_WAIT, lambda: print(f"lieint: {what} …", file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _list(_: argparse.Namespace) -> None:
    from lieint_jax.app.command import list as listing

    print(listing.text())


def _info(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import info, study

    print((study.info if study.wrote(options.path) else info.contents)(options.path))


def _plot(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import info, study

    (study.plot if study.wrote(options.path) else info.plot)(options.path, options.out, options.force)


def _animate(options: argparse.Namespace) -> None:
    from lieint_jax.app.command.animate import animate

    span = (options.first, options.last)
    animate(options.path, options.out, options.member, options.seconds, options.fps, options.force, span)


def _schema(_: argparse.Namespace) -> None:
    import json

    from lieint_jax.app import scenarios

    print(json.dumps(scenarios.schema(), indent=1, ensure_ascii=False))


def _check(options: argparse.Namespace) -> None:
    from lieint_jax.app.command import check, check_published
    from lieint_jax.app.command import list as listing

    if options.published:
        if options.system or options.scheme or options.steps or options.all:
            raise ValueError("--published has cases of its own: type lieint check --published alone")
        check_published.check()
        return
    if options.all and options.system:
        raise ValueError(f"--all is every system: type lieint check --all, or lieint check {options.system}")
    if not options.scheme and options.steps is None and not options.all:
        listing.announce(f"check {options.system}".strip())
    check.check(options.system, options.scheme, options.steps, options.all)


def _figure(options: argparse.Namespace) -> None:
    from lieint_jax.app import plots
    from lieint_jax.app.command import list as listing
    from lieint_jax.app.command.figures import FIGURES

    unknown = [n for n in options.numbers if n not in FIGURES]
    if unknown:
        every = " ".join(map(str, FIGURES))
        raise ValueError(f"figure {unknown[0]} is not one of those recomputed; lieint figure {every} makes them all")
    options.out.mkdir(parents=True, exist_ok=True)
    for n in options.numbers:
        listing.announce(f"figure {n}")
        written = ", ".join(map(str, plots.files(options.out / f"figure-{n}.png")))
        print(FIGURES[n](options.out), f"  written to {written}", sep="\n")


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
