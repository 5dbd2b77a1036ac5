"""Frozen dataclasses that are JAX pytrees."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, dataclass_transform

import jax

_T = TypeVar("_T")


def static(**options: Any) -> Any:
    """A dataclass field that is part of a pytree's structure, not one of its leaves. Its value must be hashable."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[_T]) -> type[_T]:
    """Make `cls` a frozen dataclass and a pytree whose leaves are all its fields except the `static` ones.

    The class is part of the tree's structure. With `jax.tree_util.register_dataclass` (jax 0.10) it is not: two classes
    with the same fields compare equal, and jit may then run the program that it compiled for the other one.
    """
    made: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
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
        x = object.__new__(made)
        for name, value in (*zip(fixed, structure[1:], strict=True), *zip(names, values, strict=True)):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(made, leaves_with_keys, rebuilt, leaves)
    return made


def callable_pytree(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function as a field of a pytree: itself if it is a pytree (it may have leaves), otherwise without leaves."""
    return jax.tree_util.Partial(function) if jax.tree_util.all_leaves([function]) else function
