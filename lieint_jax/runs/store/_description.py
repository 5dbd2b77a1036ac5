"""A step or a system as data: its numbers as named arrays and everything else as JSON, from which it can be rebuilt.

Classes, functions and modules are stored as names. Only names of this package are imported when a step is rebuilt:
a file must not choose which code runs.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import sys
from collections.abc import Callable, Mapping, Set
from types import ModuleType
from typing import Any

import jax
import numpy as np

from lieint_jax.core import Partitioned, Step, callable_pytree, from_fields
from lieint_jax.groups import MatrixGroup
from lieint_jax.runs._storage.leaves import store_name

_PACKAGE = __name__.partition(".")[0]


class UnknownNameError(ValueError):
    """A description names a class or a function from outside this package."""


def describe(step: Step) -> tuple[dict[str, object], dict[str, np.ndarray]]:
    """The description of a step and of its system, as values for JSON, and their arrays by name."""
    arrays: dict[str, np.ndarray] = {}
    system = _describe(step.system, "system", arrays, None)
    return {"system": system, "step": _describe(step, "step", arrays, step.system)}, arrays


def make(description: object, arrays: Mapping[str, object], own: Mapping[str, object], system: object = None) -> Any:
    """Rebuild the object of a description.

    Args:
        description: a part of a result of `describe`, its "system" or its "step".
        arrays: the arrays by name.
        own: classes and functions from outside this package, by their names in the description.
        system: the rebuilt system, for the description of a step.
    """
    if not isinstance(description, Mapping):
        return description
    [(kind, value)] = list(description.items())[:1]
    inner = {name: make(part, arrays, own, system) for name, part in description.get("fields", {}).items()}
    makers: dict[str, Callable[[], object]] = {
        "array": lambda: np.asarray(arrays[value]),
        "constant": lambda: np.array(value, description["dtype"]),
        "float": lambda: float(value),
        "tuple": lambda: tuple(make(part, arrays, own, system) for part in value),
        "name": lambda: _find_object(value, own),
        "group": lambda: MatrixGroup(np.array(inner["basis"]), inner["name"], inner["unrolled"]),
        "partial": lambda: jax.tree_util.Partial(
            make(value, arrays, own, system), *inner["args"], **dict(inner["keywords"])
        ),
        "partition": lambda: callable_pytree(make(value, arrays, own, system)),
        "same": lambda: system,
        "class": lambda: _instance(_find_object(value, own), inner),
    }
    return makers[kind]()


def _describe(x: object, path: str, arrays: dict[str, np.ndarray] | None, system: object) -> object:
    """The description of a part, and its arrays in `arrays`; without these the part is a constant, with all numbers."""

    def fields(_static: Set[str] = frozenset(), **values: object) -> dict[str, object]:
        return {
            name: _describe(value, f"{path}.{name}", None if name in _static else arrays, system)
            for name, value in values.items()
        }

    if x is system and x is not None:
        return {"same": "system"}
    if x is None or isinstance(x, bool | int | str):
        return x
    if isinstance(x, float):
        return x if math.isfinite(x) else {"float": str(x)}
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        if arrays is None:
            return {"constant": np.asarray(x).tolist(), "dtype": np.asarray(x).dtype.str}
        name = store_name(path)
        while name in arrays:  # a_b and a.b
            name += "_"
        arrays[name] = np.asarray(x)
        return {"array": name}
    if isinstance(x, tuple | list):
        return {"tuple": [_describe(part, f"{path}.{i}", arrays, system) for i, part in enumerate(x)]}
    if isinstance(x, MatrixGroup):
        return {"group": x.name, "fields": {"basis": _nested_tuples(x.basis), "name": x.name, "unrolled": x.unrolled}}
    if isinstance(x, jax.tree_util.Partial):
        inside = fields(args=x.args, keywords=tuple(x.keywords.items()))
        return {"partial": _describe(x.func, path, arrays, system), "fields": inside}
    if isinstance(x, Partitioned):
        return {"partition": _describe(x.whole, path, arrays, system)}
    if isinstance(x, ModuleType) or hasattr(x, "__qualname__"):
        return {"name": _name(x)}
    if dataclasses.is_dataclass(x):
        values = {field.name: getattr(x, field.name) for field in dataclasses.fields(x)}
        static = {field.name for field in dataclasses.fields(x) if field.metadata.get("static")}
        return {"class": _name(type(x)), "fields": fields(static, **values)}
    return {"name": f"{_name(type(x))} object"}


def _nested_tuples(x: np.ndarray) -> object:
    return {"tuple": [_nested_tuples(part) for part in x]} if x.ndim else float(x)


def _name(x: object) -> str:
    """The name of a class, function or module, in the package that exports it rather than in its own file."""
    if isinstance(x, ModuleType):
        return x.__name__
    name = getattr(x, "__qualname__", "")
    room = ".".join(x.__module__.split(".")[:2])
    public = _is_ours(x) and getattr(_import_own(room), name, None) is x
    module = x.__module__
    if module == "__main__" and (spec := getattr(sys.modules[module], "__spec__", None)):
        module = spec.name  # of a script that `python -m` runs
    return f"{room if public else module}.{name}"


def _find_object(name: str, own: Mapping[str, object]) -> Any:
    """The object of a name: one of `own`, or one of this package."""
    if name in own:
        return own[name]
    module, _, attribute = name.rpartition(".")
    found = _import_own(name) or getattr(_import_own(module), attribute, None)
    if found is not None and _is_ours(found):
        return found
    raise UnknownNameError(f"{name!r} does not belong to this package: pass it as own={{{name!r}: …}} to li.open")


def _is_ours(x: object) -> bool:
    """True if a class, function or module is defined in this package."""
    module = x.__name__ if isinstance(x, ModuleType) else getattr(x, "__module__", None)
    return isinstance(module, str) and module.partition(".")[0] == _PACKAGE


def _import_own(name: str) -> ModuleType | None:
    """The module of this package with this name, imported; None if there is none."""
    if name.partition(".")[0] != _PACKAGE:
        return None
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return None


def _instance(cls: type, fields: Mapping[str, object]) -> Any:
    """An instance of a dataclass with these fields, without the checks of its constructor, which they have passed.

    Raises:
        ValueError: it has other fields: a file must not replace its methods.
    """
    names = {field.name for field in dataclasses.fields(cls)}
    if different := sorted(names ^ fields.keys()):
        raise ValueError(f"its {cls.__name__} has other fields than that of this package: {', '.join(different)}")
    return from_fields(cls, **fields)
