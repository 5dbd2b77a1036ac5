"""A store in a folder."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import stat
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lieint_jax.runs._storage.storage import REQUESTS, Storage
from lieint_jax.runs._storage.untrusted import check_size

_STALE = 3600.0  # seconds after which an unfinished store is removed, as that of a process that was killed


class Disk(Storage):
    """A folder."""

    is_remote = False

    def __init__(self, path: Path) -> None:
        self.address = self._path = path
        self._unfinished: Path | None = None  # the folder for files that are not complete; None: their own
        self._staged: list[tuple[Path, Path]] = []  # complete files, and their places, in which they are not yet
        self._changed: set[Path] = set()  # folders whose entries may not be on disk
        self._made: set[Path] = set()  # folders whose own entries are on disk, or in the set above

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
        self._staged.append((file, target))
        with file.open("xb") as f:
            f.write(data)

    def settle(self) -> None:
        """See `Storage`: wait for the contents of all files, rename these, and wait for the entries of the folders."""
        try:
            _sync_all(file for file, _ in self._staged)
            for file, target in self._staged:
                file.rename(target)
                self._changed.add(target.parent)
        finally:
            self._discard()
        changed, self._changed = self._changed, set()
        _sync_all(changed)

    def _discard(self) -> None:
        """Remove the staged files that have not come into their places."""
        while self._staged:
            self._staged.pop()[0].unlink(missing_ok=True)

    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """See `Storage`: under a temporary name, which is changed at last, so that the store never exists in part."""
        path = self._path
        for folder in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > _STALE:
                    shutil.rmtree(folder)
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
            _sync(path.parent)
        except OSError as error:
            raise OSError(error.errno, f"{path} cannot be created: {error.strerror}; choose another store") from error
        finally:
            shutil.rmtree(unfinished._path, ignore_errors=True)
        return True

    def _make(self, folder: Path) -> None:
        """Make a folder of the store; at its first use here, as a killed process may have made it without a sync."""
        if folder in self._made:
            return
        if folder == self._path:
            folder.mkdir(parents=True, exist_ok=True)
        else:
            self._make(folder.parent)
            folder.mkdir(exist_ok=True)
            self._changed.add(folder.parent)
        self._made.add(folder)

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Storage`."""
        found, start = {}, self._path / folder
        for place, _, names in os.walk(start):
            for file in (Path(place, name) for name in names if not name.endswith(".partial")):
                with contextlib.suppress(FileNotFoundError):
                    found[file.relative_to(self._path).as_posix()] = file.stat().st_size
        return found

    @contextlib.contextmanager
    def lock(self, folder: str) -> Iterator[None]:
        """See `Storage`. The lock is released when the process ends, however it ends.

        Unfinished files of any folder are in this one meanwhile, so the next process that locks it can remove them.
        """
        path = self._path / folder
        self._make(path)
        descriptor = _lock_folder(path)
        try:
            for left in path.glob(".*.partial"):  # of a process that was killed
                left.unlink(missing_ok=True)
            self._unfinished = path
            yield
        finally:
            self._discard()
            self._unfinished = None
            os.close(descriptor)

    def check(self) -> int:
        """See `Storage`. Links to folders, which lead out of the store, are refused, too."""
        count, path = 0, self._path
        for folder, folders, names in os.walk(path):
            for link in (Path(folder, name) for name in folders if os.path.islink(Path(folder, name))):
                raise ValueError(f"{link.relative_to(path)} is a link to a folder")
            for file in (Path(folder, name) for name in names):
                try:
                    status = file.stat()
                except FileNotFoundError:
                    if file.is_symlink():
                        raise ValueError(f"{file.relative_to(path)} is a link to nothing") from None
                    continue  # a temporary file of a run that is writing
                if not stat.S_ISREG(status.st_mode):
                    raise ValueError(f"{file.relative_to(path)} is a device, a pipe or a socket")
                check_size(file.relative_to(path).as_posix(), status.st_size)
                count += 1
        return count


@contextlib.contextmanager
def _missing_folder() -> Iterator[None]:
    """A context in which a file below something that is no folder is a missing file."""
    try:
        yield
    except NotADirectoryError as error:
        raise FileNotFoundError(*error.args) from None


def _sync_all(paths: Iterable[Path]) -> None:
    """Wait until files or folders are on disk, at the same time: a journal writes all that wait for it at once."""
    paths = list(paths)
    if len(paths) < 2:  # a pool of threads costs a millisecond
        for path in paths:
            _sync(path)
        return
    with ThreadPoolExecutor(min(len(paths), REQUESTS)) as pool:
        deque(pool.map(_sync, paths), maxlen=0)


def _sync(path: Path) -> None:
    """Wait until a file, or a folder's list of entries, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lock_folder(path: Path) -> int:
    """Lock a folder against a second writer. The lock is released when the process ends, however it ends."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise BlockingIOError(f"another run is writing to {path}") from None
    except (ImportError, OSError):  # a system, or a file system, without locks
        pass
    return descriptor
