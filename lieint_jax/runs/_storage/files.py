"""The files of a store by its address, and Zarr's view of them."""

from __future__ import annotations

import asyncio
from functools import cache
from pathlib import Path
from typing import Any

from lieint_jax.runs._storage.bucket import Bucket
from lieint_jax.runs._storage.chunks import tail
from lieint_jax.runs._storage.disk import Disk
from lieint_jax.runs._storage.storage import Storage, Url, address
from lieint_jax.runs._storage.zipped import Zipped


def open_storage(place: str | Path) -> Storage:
    """The files of the store at a path or a URL."""
    found = address(place)
    if isinstance(found, Url):
        return Bucket(found)
    return Zipped(found) if found.suffix == ".zip" else Disk(found)


def open_zarr(storage: Storage, writable: bool = False) -> Any:
    """Zarr's store of a storage, for reading, or `writable` for both."""
    return _zarr_store()(storage, writable) if writable or storage.is_remote else storage.zarr_store()


@cache
def _zarr_store() -> type:
    """The class of `open_zarr`; a function, for zarr is imported where it is used."""
    from zarr.storage import WrapperStore

    class ZarrStore(WrapperStore):  # pyright: ignore[reportMissingTypeArgument]
        """Zarr's own store, but files are written, and whole objects of a bucket are read, by a `Storage`.

        `checksums` are the last four bytes of the files that it has written.
        """

        def __init__(self, storage: Storage, writable: bool) -> None:
            super().__init__(storage.zarr_store())
            self._storage, self._writable, self.checksums = storage, writable, dict[str, int]()

        def with_read_only(self, read_only: bool = False) -> Any:
            return open_zarr(self._storage) if read_only else self

        @property
        def read_only(self) -> bool:
            return not self._writable

        @property
        def supports_writes(self) -> bool:
            return self._writable

        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            if byte_range is not None or not self._storage.is_remote:
                return await super().get(key, prototype, byte_range)
            try:
                return prototype.buffer.from_bytes(await asyncio.to_thread(self._storage.read, key))
            except FileNotFoundError:
                return None

        async def set(self, key: str, value: Any) -> None:
            data = value.to_bytes()
            await asyncio.to_thread(self._storage.stage, key, data)
            self.checksums[key] = tail(data)

    return ZarrStore
