"""Runs of many processes, by `jax.distributed`: joining them, and an error that names a process that was lost."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import NoReturn

import jax
from jax.sharding import Mesh

HEARTBEAT = 10  # seconds without a sign of life after which a process counts as lost
_SIGNS = ("gloo", "nccl", "coordination", "connection closed", "unavailable")


class LostProcess(RuntimeError):  # noqa: N818
    """Another process of the run is gone."""


def initialize(coordinator: str | None = None, count: int | None = None, index: int | None = None) -> None:
    """Connect the processes of this run: those that SLURM or Open MPI started, or those described by the arguments.

    Args:
        coordinator: HOST:PORT of the first process.
        count: the number of processes.
        index: the number of this process, from 0.

    Raises:
        ValueError: arguments are missing and no launcher is found, or the processes do not connect.
    """
    given = [x is not None for x in (coordinator, count, index)]
    if any(given) and not all(given):
        raise ValueError("give all of coordinator, number of processes and index of this process, or none of them")
    try:
        jax.distributed.initialize(
            coordinator, count, index, heartbeat_timeout_seconds=HEARTBEAT, shutdown_timeout_seconds=HEARTBEAT
        )
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            f"the processes did not meet: {error}. Start them with srun or mpirun, or tell each HOST:PORT of the "
            "first, how many there are, and which it is"
        ) from error


def leave(message: str) -> NoReturn:
    """Print `message` and end this process at once: an ordinary exit would wait for the processes that are gone."""
    print(message, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1)


@contextlib.contextmanager
def watched(mesh: Mesh) -> Iterator[None]:
    """Turn the failure of a collective operation into `LostProcess`, which names the processes that are gone."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        several = len({device.process_index for device in mesh.devices.flat}) > 1
        if several and any(sign in str(error).lower() for sign in _SIGNS):
            raise LostProcess(f"{_missing()} is lost; what is in the store can be resumed") from error
        raise


def _missing() -> str:
    """The processes that do not answer, for a message. It may take a heartbeat's timeout."""
    from jax._src.distributed import global_state  # no public way to ask

    everyone = range(jax.process_count())
    try:
        live = set(global_state.client.get_live_nodes(list(everyone)))  # pyright: ignore[reportOptionalMemberAccess]
    except Exception:  # no failure here may hide the first error
        return "another process"
    gone = [str(k) for k in everyone if k not in live]
    return f"process {', '.join(gone)} of {len(everyone)}" if gone else "the connection to another process"
