"""Frozen dataclasses that are JAX pytrees."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

from lieint_jax._checks import dtype_of, name_of
from lieint_jax.core.text import fields_text

MYPY = False  # mypy takes this for True
if MYPY:
    from lieint_jax.core._of_mypy import Converted as Converted
else:
    from lieint_jax._numerics.arrays import Converted as Converted

__all__ = ["Converted", "Partitioned", "argument", "callable_pytree", "from_fields", "pytree", "static", "with_fields"]

_T = TypeVar("_T")


def static(*, converter: Callable[[Any], Any] | None = None, **options: Any) -> Any:
    """A dataclass field that is part of a pytree's structure, not one of its leaves. Its value must be hashable."""
    return dataclasses.field(metadata={"static": True, "converter": converter}, **options)


def argument(*, converter: Callable[..., Any], like: str | None = None, **options: Any) -> Any:
    """A dataclass field whose value the constructor converts, and so checks; JAX rebuilds a pytree without it.

    Its type is written `Converted[…]`, so that type checkers accept what is converted.

    With `like`, the name of a field before it, `converter(value, like=…)` is given that one's converted value too.
    """
    return dataclasses.field(metadata={"converter": converter, "like": like}, **options)


def from_fields(cls: type[_T], /, **fields: Any) -> _T:
    """An object with these fields as they are, as JAX rebuilds a pytree: converted before, or those of a batch."""
    x = object.__new__(cls)
    vars(x).update(fields)
    return x


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, argument, static))
def pytree(cls: type[_T]) -> type[_T]:
    """Make `cls` a frozen dataclass and a pytree whose leaves are all its fields except the `static` ones.

    Its `repr` is one line, with long arrays by their types and shapes, unless it has its own.

    The class is part of the tree's structure. With `jax.tree_util.register_dataclass` (jax 0.10) it is not: two classes
    with the same fields compare equal, and jit may then run the program that it compiled for the other one.
    """
    if not hasattr(cls, "__post_init__"):
        cls.__post_init__ = _convert  # pyright: ignore[reportAttributeAccessIssue]
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = fields_text  # pyright: ignore[reportAttributeAccessIssue]
    made: Any = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    fields = dataclasses.fields(made)
    names = [field.name for field in fields if not field.metadata.get("static")]
    fixed = [field.name for field in fields if field.metadata.get("static")]
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    def leaves(x: object) -> tuple[list[object], tuple[object, ...]]:
        return [getattr(x, name) for name in names], (made, *[getattr(x, name) for name in fixed])

    def leaves_with_keys(x: object) -> tuple[list[tuple[Any, object]], tuple[object, ...]]:
        values, structure = leaves(x)
        return list(zip(keys, values, strict=True)), structure

    def rebuilt(structure: tuple[object, ...], values: Iterable[object]) -> object:
        return from_fields(made, **dict(zip((*fixed, *names), (*structure[1:], *values), strict=True)))

    jax.tree_util.register_pytree_with_keys(made, leaves_with_keys, rebuilt, leaves)
    return made


def _convert(made: Any) -> None:
    """Convert the fields of a new object that have a converter.

    A method `check_fields` may then compare them, and return the values of fields that follow from others, by name.
    """
    for x in dataclasses.fields(made):
        convert, like = x.metadata.get("converter"), x.metadata.get("like")
        if convert is not None:
            fields = vars(made)
            fields[x.name] = convert(fields[x.name], **({} if like is None else {"like": fields[like]}))
    if hasattr(made, "check_fields"):
        vars(made).update(made.check_fields() or {})


def with_fields(made: _T, **values: Any) -> _T:
    """A copy with other values of some fields, also of those that no constructor takes; nothing is converted."""
    copied = copy.copy(made)
    vars(copied).update(values)
    return copied


def callable_pytree(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function as a field of a pytree: itself if all its leaves are numbers, otherwise with those leaves alone.

    A plain function has no leaves. Of a pytree with leaves that are no arrays, such as a neural network with its
    activation, the arrays can be differentiated and batched, and the rest is part of the structure.
    """
    leaves, structure = jax.tree_util.tree_flatten(function)
    if not callable(function) or all(_is_number(leaf) for leaf in leaves):
        return function
    if jax.tree_util.all_leaves([function]):
        return jax.tree_util.Partial(function)
    fixed = tuple(None if _is_number(leaf) else _Fixed(leaf) for leaf in leaves)
    return Partitioned([leaf for leaf in leaves if _is_number(leaf)], (structure, fixed))


def _is_number(leaf: object) -> bool:
    """Whether a leaf can be one of a pytree that JAX traces: an array, its shape and type, a key, a Python number."""
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.dtype.kind not in "OSUMm"
    described = dtype_of(leaf) is not None and hasattr(leaf, "shape") and not callable(leaf)
    return described or isinstance(leaf, bool | int | float | complex)


class _Fixed:
    """A part of a pytree's structure that compares by its value, or, where it cannot be hashed, as the same object."""

    def __init__(self, value: object) -> None:
        self.value = value

    def __hash__(self) -> int:
        try:
            return hash(self.value)
        except TypeError:
            return id(self.value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Fixed) or self.value is other.value:
            return isinstance(other, _Fixed)
        return isinstance(self.value, Hashable) and type(self.value) is type(other.value) and self.value == other.value


class Partitioned:
    """A callable pytree, made by `callable_pytree`, whose leaves are the arrays of another one.

    Args:
        arrays: the leaves of the other that are arrays, in order.
        rest: its structure, and each of its leaves that is no array, or None in the place of one that is.
    """

    def __init__(self, arrays: Sequence[Any], rest: tuple[Any, tuple[_Fixed | None, ...]]) -> None:
        self._arrays, self._rest = tuple(arrays), rest

    @property
    def whole(self) -> Any:
        """The other pytree, with the present arrays."""
        structure, fixed = self._rest
        arrays = iter(self._arrays)
        return structure.unflatten([next(arrays) if leaf is None else leaf.value for leaf in fixed])

    def __reduce__(self) -> tuple[Any, ...]:  # JAX cannot pickle the structure of a custom pytree
        return callable_pytree, (self.whole,)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self.whole(*arguments, **options)

    @property
    def __name__(self) -> str:
        return name_of(self.whole)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of copies in the making, and of protocols that the other does not have
            raise AttributeError(name)
        return getattr(self.whole, name)


jax.tree_util.register_pytree_node(
    Partitioned, lambda x: (x._arrays, x._rest), lambda rest, arrays: Partitioned(tuple(arrays), rest)
)
