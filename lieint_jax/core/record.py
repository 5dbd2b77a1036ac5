"""Named tuples whose `help` and `dir` show their fields and methods, without those of every tuple."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar, cast

_T = TypeVar("_T")


class _Record(type):
    def __dir__(cls) -> Iterable[str]:
        return [name for name in super().__dir__() if not hasattr(tuple, name)]


def record(cls: type[_T]) -> type[_T]:
    """Class decorator: the same named tuple, without the 100 lines on the methods of tuples in its `help`."""
    return cast("type[_T]", _Record(cls.__name__, cls.__bases__, dict(vars(cls))))
