"""One .npz for a tree of named tuples, such as the result of a study: arrays by their path, the rest as JSON text."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.runs import store as archives
from lieint_jax.types.shapes import PyTree

_PACKAGE = __name__.partition(".")[0]


def save(path: Path, tree: PyTree, metadata: dict[str, Any]) -> None:
    """Write a tree of named tuples of this package, tuples, lists, dicts, scenarios, arrays, numbers and text.

    An array is named by its path in the tree, such as `estimate.covariance`. An existing file is not replaced.

    Raises:
        TypeError: the tree has a leaf of another type.
        ValueError: two arrays would have the same name, or one that of the metadata.
        FileExistsError: the file exists.
    """
    arrays: dict[str, np.ndarray] = {}
    written = metadata | {"tree": _encode(tree, "", arrays)}
    archives.write_archive(path, arrays | {"metadata": np.array(json.dumps(written))})


def metadata(path: Path) -> dict[str, Any] | None:
    """The metadata of a file that `save` wrote; None for any other file or folder."""
    try:
        found = archives.open_archive(path).metadata
    except (ValueError, OSError):
        return None
    return found if "tree" in found else None


def load(path: Path, own: ModuleType | None = None) -> PyTree:
    """Read the tree that `save` wrote, with named tuples of this package and of the module `own`, which is imported.

    Raises:
        ValueError: there is no such file, it is damaged, or another version of the package wrote it.
    """
    found = archives.open_archive(path)
    arrays = found.read(*found.headers)
    with archives.wrap_errors(path, "holds no tree that this version of lieint_jax can read"):
        return _decode(found.metadata["tree"], arrays, own)


def _encode(value: Any, at: str, arrays: dict[str, np.ndarray]) -> Any:
    def encode_child(name: Any, inner: Any) -> Any:
        return _encode(inner, f"{at}.{name}" if at else str(name), arrays)

    match value:
        case None | bool() | int() | float() | str():
            return value
        case np.generic():
            return value.item()
        case np.ndarray() | jax.Array():
            if at in (*arrays, "metadata"):
                raise ValueError(f"two parts of the tree are called {at}")
            arrays[at] = np.asarray(value)
            return {"array": at}
        case Kind():
            return {"scenario": value.model_dump()}
        case dict():
            return {"dict": [[key, encode_child(key, inner)] for key, inner in value.items()]}
        case object(_fields=_, _asdict=named):
            kind = f"{type(value).__module__}:{type(value).__qualname__}"
            return {"type": kind, "fields": {name: encode_child(name, x) for name, x in named().items()}}
        case tuple() | list():
            return {type(value).__name__: [encode_child(k, inner) for k, inner in enumerate(value)]}
    raise TypeError(f"{at} is of type {type(value).__name__}, which cannot be written")


def _decode(value: Any, arrays: dict[str, np.ndarray], own: ModuleType | None) -> Any:
    if not isinstance(value, dict):
        return value
    if "type" in value:
        found: Any = _find_class(value["type"], own)
        return found(**{str(name): _decode(x, arrays, own) for name, x in value["fields"].items()})
    [(kind, inner)] = value.items()
    if kind == "array":
        return arrays[inner]
    if kind == "scenario":
        return scenarios.from_results(inner, "the scenario")
    if kind == "dict":
        return {key: _decode(part, arrays, own) for key, part in inner}
    return {"tuple": tuple, "list": list}[kind](_decode(part, arrays, own) for part in inner)


def _find_class(name: str, own: ModuleType | None = None) -> Any:
    """The class MODULE:NAME of named tuples, of this package or of `own`: a file must not choose what is imported."""
    module, _, kind = name.partition(":")
    home = importlib.import_module(module) if module.split(".")[0] == _PACKAGE else None
    if own is not None and module == own.__name__:
        home = own
    match home and getattr(home, kind):
        case object(_fields=_) as found if isinstance(found, type) and issubclass(found, tuple):
            return found
    raise ValueError(f"{name} is no named tuple of {_PACKAGE}; results of your own study need --study FILE.py")
