"""Where a store is, and its files in a folder or in a bucket: read, replaced and created as a whole, and durable.

A commit needs two things of a store: a file is replaced by another in one indivisible step, and of several processes
that create one store exactly one succeeds. A disk has `rename` for them, and `fsync`; object storage has PUT and PUT
with the condition that there is no such object. `Disk` and `Bucket` are these two.
"""

from __future__ import annotations

import abc
import contextlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from lieint_jax.core.record import record

ROOT = "zarr.json"  # the file of the metadata of an array, and of those of a whole store
REQUESTS = 16  # at the same time, to object storage or to a disk
_SCHEMES = ("s3", "gs", "az", "memory")
_MOST_FILES = 10**12  # of a store
_URL_AS_PATH = re.compile(rf"^({'|'.join(_SCHEMES)}):/(?!/)")  # as an option of type Path: pathlib removes a slash


class Url(str):
    """The address of a store in object storage, such as s3://bucket/run.zarr."""

    __slots__ = ()

    @property
    def name(self) -> str:
        """The last part of the address."""
        return PurePosixPath(self).name

    @property
    def suffix(self) -> str:
        """The ending of the name, .zarr."""
        return PurePosixPath(self).suffix


Address = Path | Url


def address(text: str | Path) -> Address:
    """The address of a file of results: a path or a URL.

    Raises:
        ValueError: a URL of another scheme, without a bucket or a name NAME.zarr, or with credentials in it.
    """
    if isinstance(text, Path):
        text = _URL_AS_PATH.sub(r"\1://", str(text))
    if "://" not in text:
        return Path(text)
    parts = urlsplit(text)
    if parts.scheme not in _SCHEMES:
        raise ValueError(f"a store is a path or a URL of {', '.join(_SCHEMES)}; got one of {parts.scheme!r}")
    if "@" in text or ":" in parts.netloc or parts.query or parts.fragment:  # a secret may contain a slash
        raise ValueError(
            "the URL of a store may not contain credentials or options: set them in the environment, as "
            "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        )
    if not parts.netloc or PurePosixPath(parts.path).suffix != ".zarr":
        raise ValueError(f"the URL of a store is {parts.scheme}://BUCKET/NAME.zarr, got {text}")
    return Url(text.rstrip("/"))


@record
class StoreOptions(NamedTuple):
    """The path of a store, and attributes that are written with the results.

    Attributes:
        path: a folder or a URL, whose name ends in .zarr; for `run.save` a folder, or one file NAME.zip.
        attributes: values for JSON, such as a title. The key "scenario" describes the run: a run with another scenario
            cannot resume it.
        time_unit: the unit of dt.
    """

    path: str | Path
    attributes: Mapping[str, Any] = {}
    time_unit: str = "1"

    @classmethod
    def of(cls, store: str | Path | StoreOptions) -> StoreOptions:
        """Options as given, or those of a path."""
        return store if isinstance(store, StoreOptions) else cls(store)


def checked_path(place: str | Path, file: bool = False) -> Any:
    """The path or URL of a store, checked as far as is possible before it exists; with `file` it may be a zip file."""
    path = address(place)
    if path.suffix == ".zip" and not file:
        raise ValueError(f"a run writes to a folder NAME.zarr, got {path}: run.save({path.name!r}) writes one file")
    if path.suffix not in (".zarr", ".zip"):
        raise ValueError(f"a store is a folder that ends in .zarr, got {path}")
    if isinstance(path, Path) and os.path.lexists(path) and not os.path.exists(path):
        raise ValueError(f"{path} is a link to {path.readlink()}, which does not exist; remove it or make that folder")
    return path


def check_json(attributes: Mapping[str, object]) -> None:
    """Raise ValueError if the user's attributes of a store are not values for JSON."""
    for key, value in attributes.items():
        try:
            if not isinstance(key, str):
                raise TypeError(f"names must be strings, got {key!r}")
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"attributes of a store must be values for JSON; {key!r} is not: {error}") from None


class Storage(abc.ABC):
    """The files of a store, by their names relative to it.

    All methods raise OSError when the storage fails, with a message without credentials; FileNotFoundError if a file
    that is read does not exist.
    """

    address: Address
    is_remote: bool

    @abc.abstractmethod
    def read(self, name: str) -> bytes:
        """The content of a file."""

    @abc.abstractmethod
    def tail(self, name: str) -> bytes:
        """The last four bytes of a file."""

    @abc.abstractmethod
    def stage(self, name: str, data: bytes) -> None:
        """Begin to replace or create a file in one indivisible step, which is done at the latest by `settle`."""

    def settle(self) -> None:  # noqa: B027
        """Wait until all that is staged is in its place and outlasts a loss of power.

        Where each request has waited, nothing is to do.
        """

    def put(self, name: str, data: bytes) -> None:
        """Replace or create a file in one indivisible step; when it returns, the file outlasts a loss of power."""
        self.stage(name, data)
        self.settle()

    @abc.abstractmethod
    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """Create the first files of a store, of which `root` comes first; False if there is a store already.

        Raises:
            OSError: it cannot be created.
        """

    @abc.abstractmethod
    def sizes(self, folder: str = "") -> dict[str, int]:
        """The number of bytes of each file below a folder."""

    def lock(self, folder: str) -> contextlib.AbstractContextManager[object]:
        """A context in which no other process of this machine locks the folder, where the storage has locks."""
        return contextlib.nullcontext()

    def check(self) -> int:
        """Check that all files are ordinary ones, with metadata of bounded size, and return their number.

        Object storage has no other ones, and to count them would need requests: for it the number is a limit.

        Raises:
            ValueError: something is a device, a pipe or a link to nothing, or has a name that leads out of the store.
        """
        return _MOST_FILES

    def has_store(self) -> bool:
        """True if there is a store, or on a disk anything else of its name."""
        if isinstance(self.address, Path):
            return os.path.lexists(self.address)
        try:
            self.tail(ROOT)
        except FileNotFoundError:
            return False
        return True
