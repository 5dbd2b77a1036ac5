"""Old names and old ways to call functions, which still work for one release with a `DeprecationWarning`."""

from __future__ import annotations

import functools
import importlib
import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])


def renamed(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package some of whose names have changed.

    Args:
        package: the `__name__` of the package.
        names: the new place of the object by old name: "new_name" in the same package, or "module:name".
    """

    def __getattr__(name: str) -> Any:  # noqa: N807
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, new = names[name].rpartition(":")
        where = f"{module or package}.{new}".replace("lieint_jax.", "li.")
        old = f"{package}.{name}".replace("lieint_jax.", "li.")
        warnings.warn(
            f"{old} is now {where}; the old name will be removed in version 0.4", DeprecationWarning, stacklevel=2
        )
        return _attribute_or_module(module or package, new)

    return __getattr__


def _attribute_or_module(module: str, name: str) -> object:
    """An attribute of a module, or one of its modules."""
    home = importlib.import_module(module)
    return getattr(home, name) if hasattr(home, name) else importlib.import_module(f"{module}.{name}")


def old_calls(**renamed_arguments: str) -> Callable[[_F], _F]:
    """Let a function still accept its keyword-only arguments by position, and arguments by old names (a decorator).

    Args:
        renamed_arguments: the new name of an argument by its old name.
    """

    def decorate(function: _F) -> _F:
        parameters = inspect.signature(function).parameters.values()
        by_position = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        by_keyword = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]

        @functools.wraps(function)
        def call(*args: object, **kwargs: object) -> object:
            positional, more = args[: len(by_position)], args[len(by_position) :]
            named = dict(zip(by_keyword, more, strict=False))
            if more and len(named) == len(more):
                warn_of_removal(f"{function.__name__}: pass {', '.join(named)} by name; by position")
                args, kwargs = positional, named | kwargs
            for old in renamed_arguments.keys() & kwargs.keys():
                warn_of_removal(f"{function.__name__}: {old} is now {renamed_arguments[old]}; the old name")
                kwargs[renamed_arguments[old]] = kwargs.pop(old)
            return function(*args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


def renamed_attribute(old: str, new: str) -> Any:
    """The property by which a class still has an attribute under its old name."""

    def value(instance: object) -> object:
        warn_of_removal(f"{type(instance).__name__}.{old} is now {new}; the old name")
        return getattr(instance, new)

    return property(value)


def warn_of_removal(what: str, stacklevel: int = 3) -> None:
    """Warn that an old name or call, by default one that reaches the caller of this directly, will not be accepted."""
    warnings.warn(f"{what} will not be accepted from version 0.4 on", DeprecationWarning, stacklevel=stacklevel)
