"""Wrong calls of `.state`, explained by the names of its arguments."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

_F = TypeVar("_F", bound=Callable[..., Any])


def explained(method: _F) -> _F:
    """A method whose wrong calls raise a TypeError that names the arguments it accepts."""
    signature = inspect.signature(method)

    @functools.wraps(method)
    def call(*arguments: Any, **options: Any) -> Any:
        try:
            return method(*arguments, **options)
        except TypeError:
            try:
                signature.bind(*arguments, **options)
            except TypeError as wrong:
                raise TypeError(
                    f"{method.__name__}: {wrong}; {_accepted_arguments(method.__name__, signature)}"
                ) from None
            raise

    return cast("_F", call)


def _accepted_arguments(name: str, signature: inspect.Signature) -> str:
    parameters = list(signature.parameters.values())[1:]
    named = [x.name for x in parameters if x.kind is x.KEYWORD_ONLY]
    first = ", ".join(x.name for x in parameters if x.kind is not x.KEYWORD_ONLY)
    return f"{first} may come first without a name, and {', '.join(named)} need theirs: {name}({first}, {named[0]}=...)"
