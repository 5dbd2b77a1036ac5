"""The command `study`: it runs a study, prints its report, and writes results and picture; `plot` redraws them."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import jax

from lieint_jax import _discover
from lieint_jax._version import __version__
from lieint_jax.app import plots, studies
from lieint_jax.app.command import files, result_file
from lieint_jax.app.printer import readable, show, show_time, show_written
from lieint_jax.runs import store as archives


def studies_by_name() -> dict[str, ModuleType]:
    """The studies by name."""
    return _discover.public_modules(studies)


def run(name: str, out: Path, quick: bool) -> None:
    """Run a study and write study-NAME.npz, .png and .pdf to the folder `out`, with a number if they exist already."""
    study = _find_study(name)
    out.mkdir(parents=True, exist_ok=True)
    path = files.unused_path(out / f"study-{name}.npz", _pictures)
    result = study.run(quick=quick)
    show_time("the study")
    result_file.save(path, result, {"study": name, "quick": quick, "lieint_jax": __version__, "jax": jax.__version__})
    show(study.text(result))
    drawn = plots.save(study.draw(result), path.with_suffix(".png"))
    show_written(path, *drawn, about=f"{files.megabytes(path)}; lieint plot {path} draws it again")


def _find_study(name: str) -> ModuleType:
    if name not in studies_by_name():
        raise ValueError(f"study {name!r} is not one of {', '.join(studies_by_name())}; lieint list describes them")
    return studies_by_name()[name]


def is_study_file(path: Path) -> bool:
    """Whether a file holds the results of a study."""
    return path.suffix == ".npz" and result_file.metadata(path) is not None


def info(path: Path) -> str:
    """A description of a file of a study's results, as text."""
    metadata = _metadata(path)
    title = (_find_study(metadata["study"]).__doc__ or "").splitlines()[0]
    small = ", a small one (--quick)" if metadata["quick"] else ""
    written = readable({name: metadata[name] for name in ("study", "lieint_jax", "jax")}, 200)
    return f"{title}\n  study {written['study']}{small}; lieint_jax {written['lieint_jax']}, jax {written['jax']}"


def plot(path: Path, out: Path | None = None, force: bool = False) -> None:
    """Report on the results of a study and draw them again; for `out` and `force` see `info.plot`."""
    name = _metadata(path)["study"]
    study, plain = _find_study(name), files.path_in_folder(path, out)
    files.check_replaceable(_pictures(plain), force)
    result = result_file.load(path)
    with archives.wrap_errors(path, f"holds no result of the study {name}"):
        text, figure = study.text(result), study.draw(result)
    show(text)
    drawn = plots.save(figure, plain.with_suffix(".png"))
    show_written(*drawn)


def _metadata(path: Path) -> dict[str, Any]:
    """The metadata of a file of a study's results."""
    metadata = result_file.metadata(path) or {}
    missing = {"study", "quick", "lieint_jax", "jax"} - set(metadata)
    if missing:
        raise ValueError(f"{path} is not a study written by lieint, or is damaged: its metadata lack {min(missing)!r}")
    return metadata


def _pictures(path: Path) -> list[Path]:
    return plots.files(path.with_suffix(".png"))
