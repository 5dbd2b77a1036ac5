"""Runs of many processes by `jax.distributed`: how they connect, and the error that names a lost process."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, NoReturn

import jax
from jax.sharding import Mesh

from lieint_jax import _checks

HEARTBEAT = 10  # seconds without a sign of life after which a process counts as lost
_SIGNS = ("gloo", "nccl", "coordination", "connection closed", "unavailable")


class LostProcess(RuntimeError):  # noqa: N818
    """Another process of the run has ended or cannot be reached."""


class PermanentError(ValueError):
    """A part of a run fails however often it is started: a wrong argument, or a mistake in a function of yours."""


def initialize(coordinator: str | None = None, count: int | None = None, index: int | None = None) -> None:
    """Connect the processes of this run, which SLURM, Open MPI or the user started.

    Args:
        coordinator: HOST:PORT of the first process.
        count: the number of processes.
        index: the number of this process, from 0.

    Raises:
        ValueError: arguments are missing and no launcher is found, or the processes do not connect.
    """
    given = [x is not None for x in (coordinator, count, index)]
    if any(given) and not all(given):
        raise ValueError("pass all of coordinator, number of processes and index of this process, or none of them")
    jax.config.update("jax_enable_recoverability", True)  # or the loss of a process aborts the others: see `_Watch`
    try:
        jax.distributed.initialize(
            coordinator, count, index, heartbeat_timeout_seconds=HEARTBEAT, shutdown_timeout_seconds=HEARTBEAT
        )
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            f"the processes failed to connect: {error}. Start them with srun or mpirun, or pass to each HOST:PORT of "
            "the first one, their number, and its own index"
        ) from error
    _watch.start()
    if _state().process_id == 0:
        atexit.register(_end_last)  # before the shutdown that JAX has registered


def _end_last() -> None:
    """Wait until the other processes have disconnected, for one heartbeat at most.

    This process runs the service from which they disconnect; JAX aborts a process that finds no service.
    """
    limit = time.monotonic() + HEARTBEAT
    with contextlib.suppress(Exception):  # the service has ended: there is nothing to wait for
        while _live_processes() > {0} and time.monotonic() < limit:
            time.sleep(0.05)


def leave(message: str) -> NoReturn:
    """Print `message` and end this process immediately: an ordinary exit would wait for lost processes."""
    print(_checks.printable(message, 4000), file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1)


@contextlib.contextmanager
def name_lost(mesh: Mesh) -> Iterator[None]:
    """A context in which the failure of a collective operation becomes a `LostProcess` that names lost processes."""
    _watch.begin()
    try:
        yield
    except (ValueError, RuntimeError) as error:
        several = len({device.process_index for device in mesh.devices.flat}) > 1
        if several and any(sign in str(error).lower() for sign in _SIGNS):
            raise LostProcess(f"{_watch.missing()} is lost; {_RESUMED}") from error
        raise
    finally:
        _watch.end()  # a caller that catches `LostProcess` may continue


_RESUMED = "what is in the store can be resumed"


class _Watch:
    """A thread that ends this process with a message if another process is lost.

    After a loss, the others wait in a collective operation or for each other's devices, depending on its moment. Some
    of these waits end in an error that names no process, and some never end. JAX itself would abort this process with
    a C++ stack trace.
    """

    def __init__(self) -> None:
        self._gone, self._found, self._active = "another process", threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._asking = threading.Lock()  # held during a request, in which the interpreter may not end

    def start(self) -> None:
        """Watch the processes that `initialize` has connected, from now on."""
        self.begin()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, daemon=True, name="lieint-watch")
            self._thread.start()
            atexit.register(self.end)

    def begin(self) -> None:
        """Watch again, if `start` was called."""
        self._active.set()

    def end(self) -> None:
        """Stop watching: from now on the processes may end one by one."""
        self._active.clear()
        if self._asking.acquire(timeout=HEARTBEAT):
            self._asking.release()

    def missing(self) -> str:
        """The lost processes, for a message; found after a few heartbeats at most."""
        if self._thread is None:
            self._is_any_gone()
        else:
            self._found.wait(3 * HEARTBEAT)
        return self._gone

    def _run(self) -> None:
        gone = False
        while not gone:
            self._active.wait()
            with self._asking:
                gone = self._active.is_set() and self._is_any_gone()
            time.sleep(0 if gone else 1)
        self._found.set()
        time.sleep(HEARTBEAT)  # usually the main thread reports the same error before
        if self._active.is_set():
            leave(f"lieint: {self._gone} is lost; {_RESUMED}")

    def _is_any_gone(self) -> bool:
        count = _state().num_processes  # `jax.process_count()` would wait for all devices
        try:
            live = _live_processes()
        except Exception:  # the coordinator itself is lost
            self._gone = f"process 0 of {count}"
            return True
        gone = [str(k) for k in range(count) if k not in live]
        if gone:
            self._gone = f"process {', '.join(gone)} of {count}"
        return bool(gone)


_watch = _Watch()


def _live_processes() -> set[int]:
    return set(_state().client.get_live_nodes(list(range(_state().num_processes))))


def _state() -> Any:
    """JAX's global state of the distributed run, which has no public name."""
    from jax._src.distributed import global_state

    return global_state
