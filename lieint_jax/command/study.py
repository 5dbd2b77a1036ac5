"""The command `study`: it runs a study, reports, and writes its results and its picture; `plot` draws them again."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import jax

from lieint_jax import _discover, studies
from lieint_jax._version import __version__
from lieint_jax.command import files, trees


def found() -> dict[str, ModuleType]:
    """The studies by name."""
    return _discover.modules(studies)


def run(name: str, out: Path, quick: bool) -> None:
    """Run a study; write study-NAME.npz and study-NAME.png to the folder `out`, numbered if there are some already."""
    if name not in found():
        raise ValueError(f"study {name!r} is not one of {', '.join(found())}; lieint list describes them")
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"study-{name}.npz"
    number = 1
    while path.exists() or _picture(path).exists():
        number += 1
        path = out / f"study-{name}-{number}.npz"
    result = found()[name].run(quick=quick)
    trees.save(path, result, {"study": name, "quick": quick, "lieint_jax": __version__, "jax": jax.__version__})
    print(found()[name].text(result))
    _draw(path, name, result)
    print(f"\nwritten: {path} ({files.megabytes(path)}; lieint plot {path} draws it again), {_picture(path)}")


def wrote(path: Path) -> bool:
    """Whether a file holds the results of a study."""
    return path.suffix == ".npz" and trees.metadata(path) is not None


def info(path: Path) -> str:
    """What a file of a study's results holds, in lines."""
    metadata = trees.metadata(path)
    assert metadata is not None
    title = (found()[metadata["study"]].__doc__ or "").splitlines()[0]
    small = ", a small one (--quick)" if metadata["quick"] else ""
    return f"{title}\n  study {metadata['study']}{small}; lieint_jax {metadata['lieint_jax']}, jax {metadata['jax']}"


def plot(path: Path, out: Path | None = None, force: bool = False) -> None:
    """Report on the results of a study and draw them again; for `out` and `force` see `results.plot`."""
    metadata = trees.metadata(path)
    assert metadata is not None
    plain = files.in_folder(path, out)
    if _picture(plain).exists() and not force:
        raise ValueError(files.EXISTS.format(_picture(plain)))
    result = trees.load(path)
    print(found()[metadata["study"]].text(result))
    _draw(plain, metadata["study"], result)
    print(f"\nwritten: {_picture(plain)}")


def _draw(path: Path, name: str, result: object) -> None:
    found()[name].draw(result).savefig(_picture(path), dpi=150)


def _picture(path: Path) -> Path:
    return path.with_suffix(".png")
