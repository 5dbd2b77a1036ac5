"""`li.submit`: the parts of a run as tasks of an executor, whose engine schedules, repeats and scales them."""

from __future__ import annotations

import contextlib
import inspect
import pickle
import time
import uuid
from concurrent.futures import BrokenExecutor
from functools import lru_cache, partial
from typing import Any, Literal, Protocol, Unpack, overload, runtime_checkable

import jax
import numpy as np

from lieint_jax._checks import count
from lieint_jax.core import State, Step, Trajectory
from lieint_jax.runs._execute import Bar, warn_of_failures
from lieint_jax.runs._loop import Reduction
from lieint_jax.runs._made_states import MakeStates
from lieint_jax.runs._make_run import RunOptions, run, untransformed
from lieint_jax.runs._run import Run, stored_run
from lieint_jax.runs._storage.storage import StoreOptions, address
from lieint_jax.runs._summary import MemberSummary, Summary
from lieint_jax.runs.store._reading import read_run

_PAUSE = 0.05  # seconds between two looks at the tasks
# of the caller's functions, or a package that the workers lack: a part that is repeated raises them again
_MISTAKES = (ArithmeticError, AssertionError, AttributeError, ImportError, LookupError, NameError, NotImplementedError)
_OWN = ("mesh", "part", "resume")  # arguments of `run` that each task has for itself


class LostWorkerError(RuntimeError):
    """Parts of a run did not finish, for a reason that may pass: a lost worker, a full disk."""


class PermanentError(ValueError):
    """A part of a run fails however often it is started: a wrong argument, or a mistake in a function of yours."""


@runtime_checkable
class Executor(Protocol):
    """What `submit` needs of an executor, such as those of `concurrent.futures`, Dask, mpi4py, loky and submitit."""

    def submit(self, fn: Any, /, *args: Any) -> Any:
        """The future of a call, with the methods `done`, `result` and `cancel`."""


@overload
def submit(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    parts: int,
    executor: Executor,
    reduce: None = ...,
    **options: Unpack[RunOptions],
) -> Run[Trajectory, None]: ...
@overload
def submit(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    parts: int,
    executor: Executor,
    reduce: Reduction | Literal["energy"],
    per: None = ...,
    **options: Unpack[RunOptions],
) -> Run[None, Summary]: ...
@overload
def submit(
    step: Step,
    states: State | MakeStates,
    dt: float | None = ...,
    num_steps: int | None = ...,
    *,
    parts: int,
    executor: Executor,
    reduce: Reduction | Literal["energy"],
    per: Literal["member"],
    first: Reduction | None = ...,
    **options: Unpack[RunOptions],
) -> Run[None, MemberSummary]: ...
@untransformed("li.submit")
def submit(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    *,
    parts: int,
    executor: Executor,
    **options: Any,
) -> Run:
    """Run a step from initial states in parts, each a task of an executor, and wait until all are in one store.

    The results have the bits of `li.run` in one process. The same call again, after whatever has ended the first,
    computes only what is missing. A worker that stays alive computes one part after another without compiling again, so
    let there be a few times as many parts as workers. Each starts one thread per core that it may use
    (`li.count_cores`).

    Args:
        step, states, dt, num_steps: as in `li.run`. They are sent to the workers with each part, in the precision of
            this process; where arrays of states are large, let `states` be a function. Functions from a script or a
            notebook need the package cloudpickle, which comes with Dask, loky and submitit.
        parts: the number of parts, at most that of members.
        executor: a `concurrent.futures.Executor`, such as `client.get_executor()` of Dask, or anything with its method
            `submit`, such as the executors of loky, mpi4py and submitit. Whether it starts a task again is its own
            matter: `client.get_executor(retries=3)`.
        options: further arguments of `li.run`. `store`, a folder or URL that all workers reach, must be among them;
            `progress` shows a progress bar of parts; mesh, part and resume are of one process and are not allowed.

    Returns:
        The run of all members, read from the store.

    Raises:
        TypeError: an argument that `li.run` does not have; no method `submit`; inside of jit, vmap, grad or jvp.
        PermanentError: a part fails for a reason that stays: one of those of the ValueError of `li.run`, a
            mistake in a function of yours, a package that the workers lack. The task returns it instead of raising it,
            so that no engine repeats it; parts that have not begun are canceled.
        LostWorkerError: parts whose workers were lost, or which failed for a reason that may pass, such as a full
            disk, after all others have ended. Call again to compute them.
        KeyboardInterrupt: interrupted; parts that have not begun are canceled. Call again to compute the rest.

    Warns:
        RuntimeWarning: as `li.run`, of members that fail to converge.
    """
    parts, progress, store = count("parts", parts, 1), options.pop("progress", True), options.get("store")
    refused = [name for name in _OWN if name in options]
    if refused:
        raise ValueError(f"{refused[0]} is not for a run in parts: each task has its own")
    if store is None:
        raise ValueError("the parts of a run need a store that all workers reach: store=PATH.zarr, or a URL")
    if isinstance(executor, type) or not isinstance(executor, Executor):
        raise TypeError(
            "executor must have the method submit, such as concurrent.futures.ThreadPoolExecutor(2) or "
            f"client.get_executor() of Dask, got {executor!r}"
        )
    given = {"dt": dt, "num_steps": num_steps, **options}
    inspect.signature(run).bind(step, states, **given)
    place = address(StoreOptions.of(store).path)
    try:
        import cloudpickle as pickler  # it pickles functions of a script too
    except ImportError:
        pickler = pickle
    call = pickler.dumps((step, states, given, uuid.uuid4().hex))  # the last, as Dask keeps results of equal calls
    task = partial(_run_part, call, bool(jax.config.jax_enable_x64))  # pyright: ignore[reportAttributeAccessIssue]
    _wait(*_submitted(executor, task, parts), parts, progress)
    found = stored_run(str(place), read_run(place), step)
    warn_of_failures(np.atleast_1d(found.failed), 0, step.system)
    return found


def _run_part(call: bytes, precision: bool, k: int, parts: int) -> str | None:
    """Compute part k; the message of an error that stays, which an engine would repeat if it were raised."""
    with jax.enable_x64(precision):
        try:
            step, states, options, _ = _call(call)
            run(step, states, part=(k, parts), progress=False, **options)
        except (TypeError, ValueError) as error:
            return str(error)
        except _MISTAKES as error:
            return f"{type(error).__name__}: {error}"
    return None


@lru_cache(1)
def _call(call: bytes) -> Any:
    """The arguments of a run: the same objects for all parts that this process computes, for which code is compiled."""
    return pickle.loads(call)


def _submitted(executor: Executor, task: Any, parts: int) -> tuple[dict[int, Any], dict[int, Exception]]:
    """The futures of all parts, and the errors of those that a broken pool has not accepted."""
    tasks, failed = dict[int, Any](), dict[int, Exception]()
    try:
        with getattr(executor, "batch", contextlib.nullcontext)():  # of submitit: the tasks become one array of jobs
            for k in range(parts):
                try:
                    tasks[k] = executor.submit(task, k, parts)
                except BrokenExecutor as error:
                    failed[k] = error
    except BaseException:
        for begun in tasks.values():
            begun.cancel()
        raise
    return tasks, failed


def _wait(tasks: dict[int, Any], failed: dict[int, Exception], parts: int, shown: bool) -> None:
    """Wait until all tasks have ended, and raise their errors, or those of parts that have `failed` before."""
    try:
        with Bar(shown, parts, 1, 0, unit=" parts") as bar:
            while tasks:
                for k in [k for k, task in tasks.items() if task.done()]:
                    try:
                        message = tasks.pop(k).result()
                    except Exception as error:
                        failed[k], message = error, None
                    if message is not None:
                        raise PermanentError(f"part {k} of {parts}: {message}")
                    bar.update(1)
                time.sleep(_PAUSE)
    except KeyboardInterrupt:
        done = parts - len(tasks) - len(failed)
        raise KeyboardInterrupt(
            f"stopped after {done} of {parts} parts; what is in the store is kept, to continue"
        ) from None
    finally:
        for task in tasks.values():
            task.cancel()
    if failed:
        k, error = min(failed.items(), key=lambda item: item[0])
        first = str(error).partition("\n")[0].rstrip(".")
        raise LostWorkerError(
            f"{len(failed)} of {parts} part(s) did not finish. Part {k}: {type(error).__name__}: {first}. "
            "What is in the store is kept: the same call computes the rest"
        ) from error
