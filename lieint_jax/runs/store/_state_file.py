"""The file of a state from which a run goes on: its progress, arrays by name, and a digest of both."""

from __future__ import annotations

import hashlib
import json
import math
from typing import NamedTuple

import numpy as np

from lieint_jax.runs.store._leaves import Table

_DIGEST = 32  # bytes at the end of a state
_MAX_HEADER = 2**20


class PartState(NamedTuple):
    """The published state of a part.

    Attributes:
        progress: its commits, entries along time, steps, and whether it is complete.
        arrays: the checksums of its files, and the carry of an incomplete part by name.
        initial: the digest of the initial states of its members.
        machines: the processors, versions and engines that have computed it.
    """

    progress: Table
    arrays: dict[str, np.ndarray]
    initial: str = ""
    machines: tuple[Table, ...] = ()

    def encode(self, place: Table) -> bytes:
        """The bytes of a state: a line of JSON, the arrays, and a digest; `place` is its part and its run."""
        arrays = {name: np.ascontiguousarray(x) for name, x in sorted(self.arrays.items())}
        shapes = {name: [x.dtype.newbyteorder("<").str, x.shape] for name, x in arrays.items()}
        described = {"initial states": self.initial, "progress": self.progress, "arrays": shapes}
        described["machines"] = self.machines
        header = json.dumps({**place, **described}, sort_keys=True)
        little = [x.astype(x.dtype.newbyteorder("<"), copy=False) for x in arrays.values()]
        parts = [header.encode(), b"\n", *(x.reshape(-1).view(np.uint8).data for x in little)]
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
        return b"".join([*parts, digest.digest()])


class UnusablePartError(ValueError):
    """A part whose files are damaged or belong to another run; the message names them."""


def decode_state(data: bytes, place: Table) -> PartState:
    """The inverse of `PartState.encode`.

    Raises:
        UnusablePartError: damaged, or the state of another part or run.
    """
    content, digest = memoryview(data)[:-_DIGEST], data[-_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        raise UnusablePartError("its state is altered or cut off")
    end = data.find(b"\n", 0, _MAX_HEADER)
    if end < 0:
        raise UnusablePartError("its state has too long a header")
    header, arrays, begin = json.loads(data[:end]), {}, end + 1
    for key in ("run", "part"):
        if header[key] != place[key]:
            raise UnusablePartError(f"its state is that of another {key}: the files were copied from elsewhere")
    for name, (kind, shape) in header["arrays"].items():
        dtype = np.dtype(kind)
        size = math.prod(shape) * dtype.itemsize
        arrays[name] = np.frombuffer(content[begin : begin + size], dtype).reshape(shape)
        begin += size
    return PartState(header["progress"], arrays, header["initial states"], tuple(header.get("machines", ())))
