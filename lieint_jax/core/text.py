"""Values in one line, for `repr` and for messages: long arrays by their types and shapes."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from lieint_jax._checks import concrete, dtype_of

_SHORT = 16  # the most numbers of an array, and parts of a collection, that a description shows


def short_text(value: Any) -> str:
    """A value in one line: arrays of up to 16 numbers to six digits; type and shape of a longer one or a tracer.

    Longer collections are counted, and functions with arguments are shown by these.
    """
    match value:
        case dict() | tuple() | list() if len(value) > _SHORT:
            return f"{type(value).__name__} of {len(value)}"
        case dict():
            return "{" + ", ".join(f"{name}: {short_text(inner)}" for name, inner in value.items()) + "}"
        case list():
            return f"[{', '.join(map(short_text, value))}]"
        case tuple() if type(value) is tuple:
            return f"({', '.join(map(short_text, value))}{',' * (len(value) == 1)})"
        case functools.partial():
            given = [*map(short_text, value.args), *(f"{name}={short_text(x)}" for name, x in value.keywords.items())]
            return f"{type(value).__name__}({', '.join([short_text(value.func), *given])})"
    if dtype_of(value) is None:
        return repr(value)
    if not concrete(value) or value.size > _SHORT:
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    return np.array2string(np.asarray(value), precision=6, separator=", ").replace("\n", "")


def fields_text(value: Any) -> str:
    """A dataclass in one line, such as `Law(strength=1., table=float64[13, 13])`."""
    shown = (f"{x.name}={short_text(getattr(value, x.name))}" for x in dataclasses.fields(value) if x.repr)
    return f"{type(value).__qualname__}({', '.join(shown)})"


def named_fields_text(value: Any) -> str:
    """A named tuple in one line, without its fields that are None."""
    shown = [f"{name}={short_text(x)}" for name, x in zip(value._fields, value, strict=True) if x is not None]
    return f"{type(value).__name__}({', '.join(shown)})"
