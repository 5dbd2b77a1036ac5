"""What was made for the keys used last: for all threads of a process."""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

_Made = TypeVar("_Made")


class Recent:
    """Values that are expensive to make and large, such as programs: those used last are stored.

    Keys are tuples; the first entry of a key is its kind.
    """

    def __init__(self) -> None:
        self._made: collections.OrderedDict[tuple[Any, ...], object] = collections.OrderedDict()
        # Reentrant, since a comparison of keys, or a value that is dropped, may run code that comes back here.
        self._lock = threading.RLock()

    def get(self, key: tuple[Any, ...], make: Callable[[], _Made], most: int) -> _Made:
        """The value of a key, by `make()` if none is stored; of each kind `most` values are stored.

        Two threads may both make it, and then have the same one: a lock held while JAX traces or compiles would be
        held by a thread that waits for one of JAX's.
        """
        with self._lock:
            if key in self._made:
                self._made.move_to_end(key)
                return cast("_Made", self._made[key])
        made = make()
        with self._lock:
            found = self._made.setdefault(key, made)
            self._made.move_to_end(key)
            alike = [x for x in self._made if x[0] == key[0]]
            for old in alike[: max(0, len(alike) - most)]:
                del self._made[old]
        return cast("_Made", found)

    def clear(self) -> None:
        """Drop all values."""
        with self._lock:
            self._made.clear()
