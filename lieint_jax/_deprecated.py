"""Old names and calls of version 0.3, which work in 0.4 with a `DeprecationWarning`."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])


def old_calls(function: _F) -> _F:
    """Let a function still accept its keyword-only arguments by position (a decorator)."""
    parameters = inspect.signature(function).parameters.values()
    by_position = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)
    by_keyword = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]

    @functools.wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        more = args[by_position:]
        if 0 < len(more) <= len(by_keyword):
            named = dict(zip(by_keyword, more, strict=False))
            warn_of_removal(f"{function.__name__}: pass {', '.join(named)} by name; by position")
            args, kwargs = args[:by_position], named | kwargs
        return function(*args, **kwargs)

    return call  # type: ignore[return-value]


def renamed_attribute(old: str, new: str) -> Any:
    """The property by which a class still has an attribute under its old name."""

    def value(instance: object) -> object:
        warn_of_removal(f"{type(instance).__name__}.{old} is now {new}; the old name")
        return getattr(instance, new)

    return property(value)


def warn_of_removal(what: str, stacklevel: int = 3) -> None:
    """Warn that an old name or call, by default one that reaches the caller of this directly, will not be accepted."""
    warnings.warn(f"{what} will not be accepted from version 0.5 on", DeprecationWarning, stacklevel=stacklevel)
