"""A store in one file NAME.zip, Zarr's zip store: the files of a folder NAME.zarr, none of them compressed."""

from __future__ import annotations

import os
import stat
import zipfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import NoReturn

from lieint_jax import _checks
from lieint_jax.runs._storage.storage import Storage
from lieint_jax.runs._storage.untrusted import NAME, check_size

_ENCRYPTED = 0x1  # a flag of an entry


class Zipped(Storage):
    """A zip file, which is only read; nothing in it is extracted to a disk."""

    is_remote = False

    def __init__(self, path: Path) -> None:
        self.address = self._path = path

    @cached_property
    def _archive(self) -> zipfile.ZipFile:
        return zipfile.ZipFile(self._path)

    def read(self, name: str) -> bytes:
        """See `Storage`."""
        try:
            return self._archive.read(name)
        except KeyError:
            raise FileNotFoundError(f"{self._path} has no file {name}") from None
        except OSError:
            raise
        except Exception as error:  # a crafted file can make zipfile raise anything
            raise OSError(f"{name} of {self._path} cannot be read: {error}") from error

    def tail(self, name: str) -> bytes:
        """See `Storage`."""
        return self.read(name)[-4:]

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Storage`."""
        below = f"{folder}/" if folder else ""
        return {x.filename: x.file_size for x in self._archive.infolist() if x.filename.startswith(below)}

    def stage(self, name: str, data: bytes) -> NoReturn:
        """See `Storage`: a zip file is written as a whole."""
        raise OSError(f"{self._path} is a finished store and is not written to")

    def create_store(self, root: str, files: Mapping[str, bytes]) -> NoReturn:
        """See `Storage`: `zip_folder` makes one."""
        self.stage(root, files[root])

    def check(self) -> int:
        """See `Storage`.

        Raises:
            ValueError: a file has a name that leads elsewhere, is a link, encrypted or compressed, or occurs twice; or
                they overlap, so that they have more bytes than the zip file.
        """
        total, seen = 0, set()
        for entry in self._archive.infolist():
            name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
            if not all(map(NAME.fullmatch, name.split("/"))) or kind not in (0, stat.S_IFREG):
                raise ValueError(f"{name!r} is not the name of an ordinary file of a store")
            if name in seen:
                raise ValueError(f"it has two files {name}")
            if entry.flag_bits & _ENCRYPTED:
                raise ValueError(f"{name} is encrypted")
            if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
                raise ValueError(f"{name} is compressed, which no store is: zip the content of its folder by zip -0rD")
            check_size(name, entry.file_size)
            total += entry.file_size
            seen.add(name)
        if total > (size := self._path.stat().st_size):
            raise ValueError(f"its {_checks.spoken_size(size)} would expand to {_checks.spoken_size(total)}")
        return len(seen)


def zip_folder(folder: Path, path: Path) -> None:
    """Write all files of a folder to a new zip file, which has the same bytes whenever it is written."""
    with path.open("xb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for part in sorted(x for x in folder.rglob("*") if x.is_file()):
                archive.writestr(zipfile.ZipInfo(part.relative_to(folder).as_posix()), part.read_bytes())
        file.flush()
        os.fsync(file.fileno())
