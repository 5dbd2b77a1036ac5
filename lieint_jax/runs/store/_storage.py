"""The files of a store in a folder or in a bucket: read, replaced and created as a whole, and durable when it returns.

A commit needs two things of a store: a file is replaced by another in one indivisible step, and of several processes
that create one store exactly one succeeds. A disk has `rename` for them, and `fsync`; object storage has PUT and PUT
with the condition that there is no such object. `Disk` and `Bucket` are these two.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import glob
import os
import random
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from functools import cache, cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from urllib.parse import urlsplit

_T = TypeVar("_T")
_SCHEMES = ("s3", "gs", "az", "memory")
_SECRET = re.compile("SECRET|TOKEN|PASSWORD|ACCESS_KEY|ACCOUNT_KEY|CREDENTIAL|SAS")  # in the names of variables
_FIRST_DELAY, _LONGEST_DELAY = 0.1, 20.0  # seconds before the first retry of a request, and at most before another
_PATIENCE, _FIRST_PATIENCE = (
    600.0,
    30.0,
)  # seconds for which a request is retried; the first one, whose address may be wrong
_STALE = 3600.0  # seconds after which an unfinished store counts as abandoned
_TIMEOUT = 60.0  # seconds without an answer after which a request has failed


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
    if isinstance(text, Path) or "://" not in text:
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
        """Replace or create a file in one indivisible step; after `settle` it outlasts a loss of power."""

    @abc.abstractmethod
    def settle(self) -> None:
        """Wait until all that is staged outlasts a loss of power."""

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

    @abc.abstractmethod
    def lock(self, folder: str, alone: bool = True) -> contextlib.AbstractContextManager[object]:
        """A context in which no other process of this machine locks the folder, where the storage has locks.

        With `alone=False` for the other processes of a run whose first one has locked it.
        """

    @abc.abstractmethod
    def arrays(self) -> Any:
        """Zarr's store of these files, for reading."""

    def has_store(self) -> bool:
        """True if there is a store, or on a disk anything else of its name."""
        if isinstance(self.address, Path):
            return os.path.lexists(self.address)
        try:
            self.tail("zarr.json")
        except FileNotFoundError:
            return False
        return True


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
            self.checksums[key] = int.from_bytes(data[-4:], "little")

    return WritingStore


def writable_arrays(storage: Storage) -> Any:
    """Zarr's store of a storage, which writes each file in one step and records the checksums at their ends."""
    return _writing_store()(storage)


class Disk(Storage):
    """A folder."""

    is_remote = False

    def __init__(self, path: Path) -> None:
        self.address = self._path = path
        self._unfinished: Path | None = None  # the folder for files that are not complete; None: their own
        self._changed: set[Path] = set()  # folders whose entries may not be on disk

    def read(self, name: str) -> bytes:
        """See `Storage`."""
        with _missing_folder():
            return (self._path / name).read_bytes()

    def tail(self, name: str) -> bytes:
        """See `Storage`."""
        with _missing_folder(), (self._path / name).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 4))
            return file.read()

    def stage(self, name: str, data: bytes) -> None:
        """See `Storage`."""
        target = self._path / name
        self._make(target.parent)
        folder = self._unfinished or target.parent
        file = folder / f".{target.name}.{os.getpid()}-{os.urandom(4).hex()}.partial"
        try:
            with file.open("xb") as f:
                f.write(data)
                f.flush()
                os.fsync(f.fileno())
            file.rename(target)
        finally:
            file.unlink(missing_ok=True)
        self._changed.add(target.parent)

    def settle(self) -> None:
        """See `Storage`: wait for the entries of the folders."""
        while self._changed:
            sync(self._changed.pop())

    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """See `Storage`: under a temporary name, which is changed at last, so that the store never exists in part."""
        path = self._path
        _remove_stale(path)
        unfinished = Disk(path.with_name(f".{path.name}.{os.getpid()}-{os.urandom(4).hex()}.partial"))
        try:
            for name, data in files.items():
                unfinished.stage(name, data)
            unfinished.settle()
            try:
                unfinished._path.rename(path)
            except OSError:
                if os.path.lexists(path / root):
                    return False
                raise
            sync(path.parent)
        except OSError as error:
            raise OSError(error.errno, f"{path} cannot be created: {error.strerror}; choose another store") from error
        finally:
            shutil.rmtree(unfinished._path, ignore_errors=True)
        return True

    def _make(self, folder: Path) -> None:
        if folder.is_dir():
            return
        self._make(folder.parent)
        folder.mkdir(exist_ok=True)
        self._changed.add(folder.parent)

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Storage`."""
        found, start = {}, self._path / folder
        for place, _, names in os.walk(start):
            for file in (Path(place, name) for name in names if not name.endswith(".partial")):
                with contextlib.suppress(FileNotFoundError):
                    found[file.relative_to(self._path).as_posix()] = file.stat().st_size
        return found

    @contextlib.contextmanager
    def lock(self, folder: str, alone: bool = True) -> Iterator[None]:
        """See `Storage`. The lock is released when the process ends, however it ends.

        Unfinished files of any folder are in this one meanwhile, so the next process that locks it can remove them.
        """
        path = self._path / folder
        self._make(path)
        descriptor = lock_folder(path) if alone else None
        try:
            for left in path.glob(".*.partial") if alone else ():  # of a process that was killed
                left.unlink(missing_ok=True)
            self._unfinished = path
            yield
        finally:
            self._unfinished = None
            if descriptor is not None:
                os.close(descriptor)

    def arrays(self) -> Any:
        """See `Storage`."""
        from zarr.storage import LocalStore

        return LocalStore(self._path, read_only=True)


class Bucket(Storage):
    """Objects below a prefix in a bucket, by `obstore`. Every request that fails is repeated, with backoff."""

    is_remote = True

    def __init__(self, url: Url) -> None:
        self.address = self._url = url
        self._reached = False  # whether a request has succeeded

    @cached_property
    def _store(self) -> Any:
        """The bucket; the environment holds its credentials, region and endpoint, in the names of its provider."""
        try:
            import obstore.store
        except ImportError:
            raise ValueError(
                f"{self.address} is in object storage, which needs obstore: pip install 'lieint_jax[cloud]'"
            ) from None
        if urlsplit(self._url).scheme == "memory":
            return _memory(self._url)
        options = {"timeout": timedelta(seconds=_TIMEOUT), "allow_http": _allows_http()}
        no_retry = {"max_retries": 0, "retry_timeout": timedelta(seconds=2 * _TIMEOUT)}  # `_retry` repeats requests
        try:
            return obstore.store.from_url(self._url, client_options=options, retry_config=no_retry)  # pyright: ignore
        except Exception as error:
            raise ValueError(f"{self.address} cannot be opened: {message(error)}") from None

    def read(self, name: str) -> bytes:
        """See `Storage`."""
        return self._retry(name, lambda obs: obs.get(self._store, name).bytes().to_bytes())

    def tail(self, name: str) -> bytes:
        """See `Storage`."""
        last = {"range": {"suffix": 4}}
        return self._retry(name, lambda obs: obs.get(self._store, name, options=last).bytes().to_bytes())

    def stage(self, name: str, data: bytes) -> None:
        """See `Storage`."""
        try:
            self._retry(name, lambda obs: obs.put(self._store, name, data))
        except FileNotFoundError:
            raise OSError(f"{self.address} cannot be written: there is no such bucket") from None

    def settle(self) -> None:
        """See `Storage`: each request has waited."""

    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """See `Storage`. If an answer was lost, the repeated request finds the object that the first has created."""
        import obstore.exceptions

        try:
            self._retry(root, lambda obs: obs.put(self._store, root, files[root], mode="create"))
        except (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError):
            return self.read(root) == files[root]
        return True

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Storage`."""

        def listed(obs: Any) -> dict[str, int]:
            batches = obs.list(self._store, folder or None)
            return {entry["path"]: entry["size"] for batch in batches for entry in batch}

        return self._retry(folder, listed)

    def lock(self, folder: str, alone: bool = True) -> contextlib.AbstractContextManager[object]:
        """See `Storage`: object storage has no locks."""
        return contextlib.nullcontext()

    def arrays(self) -> Any:
        """See `Storage`."""
        return _reading_store()(self)

    def zarr_store(self) -> Any:
        """Zarr's own store of the bucket."""
        from zarr.storage import ObjectStore

        return ObjectStore(self._store, read_only=True)

    def _retry(self, name: str, request: Callable[[Any], _T]) -> _T:
        """The result of a request, which is repeated while it fails for a reason that may pass."""
        import obstore
        from obstore import exceptions

        store = self._store  # a ValueError of its own if there is none
        final = (exceptions.AlreadyExistsError, exceptions.PreconditionError)
        refused = (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError)
        wrong = (exceptions.NotSupportedError, exceptions.InvalidPathError, exceptions.UnknownConfigurationKeyError)
        start, delay = time.monotonic(), _FIRST_DELAY
        while store is not None:
            try:
                result = request(obstore)
            except FileNotFoundError:
                self._reached = True
                raise FileNotFoundError(f"{self.address} has no object {name}") from None
            except final:
                raise
            except (*refused, *wrong) as error:
                raise PermissionError(f"{self.address} refuses the request: {message(error)}") from None
            except (exceptions.BaseError, OSError, TimeoutError) as error:
                if time.monotonic() - start > (_PATIENCE if self._reached else _FIRST_PATIENCE):
                    raise OSError(f"{self.address} cannot be reached: {message(error)}") from None
                time.sleep(delay * random.uniform(0.5, 1.0))  # so that the clients of a busy server do not beat in time
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            self._reached = True
            return result
        raise AssertionError


@cache
def _reading_store() -> type:
    """The class of `Bucket.arrays`."""
    from zarr.storage import WrapperStore

    class ReadingStore(WrapperStore):  # pyright: ignore[reportMissingTypeArgument]
        """Zarr's store of a bucket, whose requests for whole objects are repeated as in `Bucket`."""

        def __init__(self, bucket: Bucket) -> None:
            super().__init__(bucket.zarr_store())
            self._bucket = bucket

        def with_read_only(self, read_only: bool = False) -> Any:
            return self

        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            if byte_range is not None:
                return await super().get(key, prototype, byte_range)
            try:
                return prototype.buffer.from_bytes(await asyncio.to_thread(self._bucket.read, key))
            except FileNotFoundError:
                return None

    return ReadingStore


def open_storage(place: str | Path) -> Storage:
    """The files of the store at a path or a URL."""
    found = address(place)
    return Bucket(found) if isinstance(found, Url) else Disk(found)


def message(error: BaseException) -> str:
    """The first line of an error's message, without anything that the environment holds as a secret."""
    [line, *_] = str(error).splitlines() or [""]
    line = re.sub(r"\?\S+", "?…", re.sub(r"<\?xml.*", "", line)).strip().rstrip(":")
    for key, value in os.environ.items():
        if _SECRET.search(key.upper()) and len(value) > 3:
            line = line.replace(value, "…")
    return f"{type(error).__name__}: {line}" if line else type(error).__name__


@cache
def _memory(url: str) -> Any:
    """The objects in this process' memory at a URL memory://…"""
    from obstore.store import MemoryStore

    return MemoryStore()


def _allows_http() -> bool:
    """True if requests may be sent without encryption: the user has given an endpoint http://…, or allows it."""
    endpoints = [os.environ.get(key, "") for key in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT", "AWS_ENDPOINT_URL_S3")]
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
    return allowed or any(endpoint.startswith("http://") for endpoint in endpoints)


@contextlib.contextmanager
def _missing_folder() -> Iterator[None]:
    """A context in which a file below something that is no folder is a missing file."""
    try:
        yield
    except NotADirectoryError as error:
        raise FileNotFoundError(*error.args) from None


def _remove_stale(path: Path) -> None:
    """Remove unfinished folders of stores at `path` that a process left long ago when it was killed."""
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > _STALE:
                shutil.rmtree(folder)


def sync(path: Path) -> None:
    """Wait until a file, or a folder's list of entries, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_folder(path: Path) -> int:
    """Lock a folder against a second writer. The lock is released when the process ends, however it ends."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ValueError(f"another run is writing to {path}") from None
    except (ImportError, OSError):  # a system, or a file system, without locks
        pass
    return descriptor
