"""The files of a store by its address."""

from __future__ import annotations

from pathlib import Path

from lieint_jax.runs._storage.bucket import Bucket
from lieint_jax.runs._storage.disk import Disk
from lieint_jax.runs._storage.storage import Storage, Url, address
from lieint_jax.runs._storage.zipped import Zipped


def open_storage(place: str | Path) -> Storage:
    """The files of the store at a path or a URL."""
    found = address(place)
    if isinstance(found, Url):
        return Bucket(found)
    return Zipped(found) if found.suffix == ".zip" else Disk(found)
