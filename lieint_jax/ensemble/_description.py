"""A step or a system as data: its numbers as named arrays, and everything else as JSON, from which it is made again.

Classes, functions and modules are written down as names. Only names of this package are imported when a step is made
again: a file must not choose what code is run.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType
from typing import Any

import jax
import numpy as np

from lieint_jax.ensemble._store import store_name
from lieint_jax.groups._matrix import MatrixGroup
from lieint_jax.types import Step

_PACKAGE = __name__.partition(".")[0]
_RENAMED = {  # since version 0.2
    "ManyFreeBodies": "FreeBodies",
    "Quadratic": "QuadraticPotential",
    "SpinUp": "SpinUpMotor",
    "Sum": "SumPotential",
    "Uniform": "UniformGravity",
}


class UnknownNameError(ValueError):
    """A description names a class or a function that is not of this package."""


def describe(step: Step) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The description of a step and of its system, which JSON can hold, and their arrays by name."""
    arrays: dict[str, np.ndarray] = {}
    system = _describe(step.system, "system", arrays, None)
    return {"system": system, "step": _describe(step, "step", arrays, step.system)}, arrays


def make(description: Any, arrays: Mapping[str, Any], own: Mapping[str, Any]) -> Any:
    """What a description describes.

    Args:
        description: a part of what `describe` gives, such as its "system".
        arrays: by name.
        own: classes and functions that are not of this package, by the names that they are described by.
    """
    if not isinstance(description, Mapping):
        return description
    [(kind, value)] = list(description.items())[:1]
    inner = {name: make(part, arrays, own) for name, part in description.get("fields", {}).items()}
    makers: dict[str, Callable[[], Any]] = {
        "array": lambda: np.asarray(arrays[value]),
        "float": lambda: float(value),
        "tuple": lambda: tuple(make(part, arrays, own) for part in value),
        "name": lambda: _find_object(value, own),
        "group": lambda: MatrixGroup(np.array(inner["basis"]), inner["name"], inner["unrolled"]),
        "partial": lambda: jax.tree_util.Partial(make(value, arrays, own), *inner["args"], **dict(inner["keywords"])),
        "class": lambda: _instance(_find_object(value, own), inner),
    }
    return makers[kind]()


def _describe(x: Any, path: str, arrays: dict[str, np.ndarray], system: Any) -> Any:
    def fields(**values: Any) -> dict[str, Any]:
        return {name: _describe(value, f"{path}.{name}", arrays, system) for name, value in values.items()}

    if x is system and x is not None:
        return {"same": "system"}
    if x is None or isinstance(x, bool | int | str):
        return x
    if isinstance(x, float):
        return x if math.isfinite(x) else {"float": str(x)}
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        name = store_name(path)
        while name in arrays:  # a_b and a.b
            name += "_"
        arrays[name] = np.asarray(x)
        return {"array": name}
    if isinstance(x, tuple | list):
        return {"tuple": [_describe(part, f"{path}.{i}", arrays, system) for i, part in enumerate(x)]}
    if isinstance(x, MatrixGroup):
        return {"group": x.name, "fields": {"basis": _lists(x.basis), "name": x.name, "unrolled": x.unrolled}}
    if isinstance(x, jax.tree_util.Partial):
        inside = fields(args=x.args, keywords=tuple(x.keywords.items()))
        return {"partial": _describe(x.func, path, arrays, system), "fields": inside}
    if isinstance(x, ModuleType) or hasattr(x, "__qualname__"):
        return {"name": _name(x)}
    if dataclasses.is_dataclass(x):
        values = {field.name: getattr(x, field.name) for field in dataclasses.fields(x)}
        return {"class": _name(type(x)), "fields": fields(**values)}
    return {"name": f"{_name(type(x))} object"}


def _lists(x: np.ndarray) -> Any:
    return {"tuple": [_lists(part) for part in x]} if x.ndim else float(x)


def _name(x: Any) -> str:
    """The name of a class, function or module: in the package that exports it, wherever in that it is defined."""
    if isinstance(x, ModuleType):
        return x.__name__
    name = getattr(x, "__qualname__", "")
    room = ".".join(x.__module__.split(".")[:2])
    public = _is_ours(x) and getattr(_import_own(room), name, None) is x
    return f"{room if public else x.__module__}.{name}"


def _find_object(name: str, own: Mapping[str, Any]) -> Any:
    """The object of a name: one of `own`, or one of this package."""
    if name in own:
        return own[name]
    for candidate in (name, *_names_of_0_2(name)):
        module, _, attribute = candidate.rpartition(".")
        found = _import_own(candidate) or getattr(_import_own(module), attribute, None)
        if found is not None and _is_ours(found):
            return found
    raise UnknownNameError(f"{name!r} is not of this package: give it by own={{{name!r}: …}}")


def _names_of_0_2(name: str) -> Iterator[str]:
    """Where an object is now that version 0.2 wrote down under this name."""
    module, _, attribute = name.rpartition(".")
    attribute = _RENAMED.get(attribute, attribute)
    room, _, file = module.rpartition(".")
    yield f"{room}._{file}.{attribute}"
    yield f"{room}._shared.{file.lstrip('_')}.{attribute}"
    yield f"{_PACKAGE}.app{module.removeprefix(_PACKAGE)}.{attribute}"


def _is_ours(x: Any) -> bool:
    """Whether a class, function or module is defined in this package."""
    module = x.__name__ if isinstance(x, ModuleType) else getattr(x, "__module__", None)
    return isinstance(module, str) and module.partition(".")[0] == _PACKAGE


def _import_own(name: str) -> ModuleType | None:
    """The module of this package with this name, or None."""
    if name.partition(".")[0] != _PACKAGE:
        return None
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return None


def _instance(cls: type, fields: Mapping[str, Any]) -> Any:
    """An instance of a dataclass with these fields, made without its checks, which its maker has done."""
    x = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(x, name, value)
    return x
