"""The files of a store by its address, and Zarr's view of them for writing."""

from __future__ import annotations

import asyncio
from functools import cache
from pathlib import Path
from typing import Any

from lieint_jax.runs.store._bucket import Bucket
from lieint_jax.runs.store._chunks import tail
from lieint_jax.runs.store._disk import Disk
from lieint_jax.runs.store._storage import Storage, Url, address


def open_storage(place: str | Path) -> Storage:
    """The files of the store at a path or a URL."""
    found = address(place)
    return Bucket(found) if isinstance(found, Url) else Disk(found)


@cache
def _writing_store() -> type:
    """The class of `writable_arrays`; a function, for zarr is imported where it is used."""
    from zarr.storage import WrapperStore

    class WritingStore(WrapperStore):  # pyright: ignore[reportMissingTypeArgument]
        """Zarr's store, whose files are written by `Storage.stage`; `checksums` are their last four bytes."""

        def __init__(self, storage: Storage) -> None:
            super().__init__(storage.arrays())
            self._storage, self.checksums = storage, dict[str, int]()

        def with_read_only(self, read_only: bool = False) -> Any:
            return self._store.with_read_only(True) if read_only else self

        @property
        def read_only(self) -> bool:
            return False

        @property
        def supports_writes(self) -> bool:
            return True

        async def set(self, key: str, value: Any) -> None:
            data = value.to_bytes()
            await asyncio.to_thread(self._storage.stage, key, data)
            self.checksums[key] = tail(data)

    return WritingStore


def writable_arrays(storage: Storage) -> Any:
    """Zarr's store of a storage, which writes each file in one step and records the checksums at their ends."""
    return _writing_store()(storage)
