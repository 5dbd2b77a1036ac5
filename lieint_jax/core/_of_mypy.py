"""The type of a field with a converter for mypy, which knows no converters, and never runs this file."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

_T = TypeVar("_T", covariant=True)


class Converted(Generic[_T]):
    """A field that is given as anything, and read as a `_T`."""

    def __get__(self, instance: object, owner: Any = None) -> _T:
        raise NotImplementedError

    def __set__(self, instance: Any, value: Any) -> None:
        raise NotImplementedError
