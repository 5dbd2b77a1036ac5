"""The command `study`: it runs a study, prints its report, and writes results and picture; `plot` redraws them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
from matplotlib.figure import Figure

from lieint_jax import _discover, plots
from lieint_jax._version import __version__
from lieint_jax.app import studies
from lieint_jax.app._own_file import import_file
from lieint_jax.app.command import files, result_file
from lieint_jax.app.printer import readable, show, show_time, show_written
from lieint_jax.app.studies.inference import draw, text
from lieint_jax.fitting.inference import Inference, Problem, infer
from lieint_jax.runs import store as archives
from lieint_jax.types.shapes import PyTree

_OWN = "lieint_own_study"  # the module of a file of the user's


class Study(NamedTuple):
    """The three functions of a study, and the module of a study of the user's with functions of its own."""

    run: Callable[..., PyTree]
    text: Callable[[PyTree], str]
    draw: Callable[[PyTree], Figure]
    module: ModuleType | None = None


def studies_by_name() -> dict[str, ModuleType]:
    """The studies by name."""
    return {name: module for name, module in _discover.public_modules(studies).items() if "run" in vars(module)}


def run(name: str, out: Path, quick: bool) -> None:
    """Run a study, of the package or of a file NAME.py.

    It writes study-NAME.npz, .png and .pdf to the folder `out`, with a number if they exist already.
    """
    own = name.endswith(".py")
    study = _own_study(Path(name)) if own else _find_study(name)
    files.make_folder(out)
    path = files.unused_path(out / f"study-{Path(name).stem if own else name}.npz", _pictures)
    result = study.run(quick=quick)
    show_time("the study")
    metadata = {"study": Path(name).name, "quick": quick, "lieint_jax": __version__, "jax": jax.__version__}
    result_file.save(path, result, metadata)
    show(study.text(result))
    drawn = plots.save(study.draw(result), path.with_suffix(".png"))
    needed = f" --study {name}" if study.module is not None else ""
    show_written(path, *drawn, about=f"{files.megabytes(path)}; lieint plot {path}{needed} draws it again")


def _find_study(name: str) -> Study:
    if name not in studies_by_name():
        known = ", ".join(studies_by_name())
        raise ValueError(
            f"study {name!r} is not one of {known}; lieint list describes them; a study of your own is a file NAME.py"
        )
    module = studies_by_name()[name]
    return Study(module.run, module.text, module.draw)


def _own_study(path: Path) -> Study:
    """The study that a file declares: `PROBLEM`, a `Problem`, or the functions run, text and draw."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    module = import_file(path, _OWN)
    declared = vars(module)
    if isinstance(problem := declared.get("PROBLEM"), Problem):
        return Study(partial(infer, problem), text, draw)
    if missing := [name for name in ("run", "text", "draw") if not callable(declared.get(name))]:
        raise ValueError(
            f"{path} declares no study: it needs PROBLEM = lieint_jax.fitting.inference.Problem(…), or the "
            f"functions run, text and draw, of which it lacks {', '.join(missing)}"
        )
    return Study(module.run, module.text, module.draw, module)


def is_study_file(path: Path) -> bool:
    """Whether a file holds the results of a study."""
    return path.suffix == ".npz" and result_file.metadata(path) is not None


def info(path: Path) -> str:
    """A description of a file of a study's results, as text."""
    metadata = _metadata(path)
    title = "A study of your own"
    if not _is_own(metadata):
        _find_study(metadata["study"])
        title = (studies_by_name()[metadata["study"]].__doc__ or "").splitlines()[0]
    small = ", a small one (--quick)" if metadata["quick"] else ""
    written = readable({name: metadata[name] for name in ("study", "lieint_jax", "jax")}, 200)
    return f"{title}\n  study {written['study']}{small}; lieint_jax {written['lieint_jax']}, jax {written['jax']}"


def plot(path: Path, out: Path | None = None, force: bool = False, own: Path | None = None) -> None:
    """Report on the results of a study and draw them again; for `out` and `force` see `info.plot`.

    A file of results never chooses what is imported: those of a study of the user's need its file, `own`, unless it
    declares a `Problem`, whose results need nothing.
    """
    metadata, plain = _metadata(path), files.path_in_folder(path, out)
    name = readable(metadata["study"], 200)
    if own is not None and not _is_own(metadata):
        raise ValueError(f"{path} holds results of the study {name} of this package: leave out --study")
    if own is not None:
        study = _own_study(own)
    elif _is_own(metadata):
        study = Study(infer, text, draw)
    else:
        study = _find_study(metadata["study"])
    files.check_replaceable(_pictures(plain), force)
    result = result_file.load(path, study.module)
    if own is None and _is_own(metadata) and not isinstance(result, Inference):
        raise ValueError(f"{path} holds results of your own study {name}, which lieint plot needs: add --study {name}")
    with archives.wrap_errors(path, f"holds no result of the study {name}"):
        report, figure = study.text(result), study.draw(result)
    show(report)
    drawn = plots.save(figure, plain.with_suffix(".png"))
    show_written(*drawn)


def _is_own(metadata: dict[str, Any]) -> bool:
    return str(metadata["study"]).endswith(".py")


def _metadata(path: Path) -> dict[str, Any]:
    """The metadata of a file of a study's results."""
    metadata = result_file.metadata(path) or {}
    missing = {"study", "quick", "lieint_jax", "jax"} - set(metadata)
    if missing:
        raise ValueError(f"{path} is not a study written by lieint, or is damaged: its metadata lack {min(missing)!r}")
    return metadata


def _pictures(path: Path) -> list[Path]:
    return plots.files(path.with_suffix(".png"))
