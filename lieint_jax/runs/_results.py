"""The results of a batch, computed in one compiled loop, in memory or in a store."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import numpy as np
from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jax.sharding import Mesh

from lieint_jax import _checks
from lieint_jax.runs import _layout, processes
from lieint_jax.runs._engine import engine_of
from lieint_jax.runs._execute import MemoryOutput, execute
from lieint_jax.runs._job import Job, rows_and_carry
from lieint_jax.runs._layout import Layout
from lieint_jax.runs._made_states import MakeStates, made_states
from lieint_jax.runs._make_job import make_jobs
from lieint_jax.runs._part_of_task import checked_part, part_of_task
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._leaves import Saves
from lieint_jax.runs.store._reading import read_written
from lieint_jax.runs.store._storage import StoreOptions, Url, address, checked_path
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.types import State, Step

_F = TypeVar("_F", bound=Callable[..., Any])


class Results(NamedTuple):
    """What a run gives.

    Attributes:
        job: the run, or the part of it that this process has computed.
        engine: the name of the engine that computed it.
        saves: those of the part.
        path: the path of its store; "" of a run in memory.
    """

    job: Job
    engine: str
    saves: Saves
    path: str = ""


def untransformed(name: str) -> Callable[[_F], _F]:
    """Raise TypeError where a function is called with tracers, or meets those of a function that closes over them."""
    advice = (
        f"{name} computes with numbers, outside of jax.jit, jax.vmap, jax.grad and jax.jvp: "
        "inside of them use li.integrate, for a batch jax.vmap(lambda z: li.integrate(step, z, dt, num_steps))(states)"
    )

    def decorate(function: _F) -> _F:
        @wraps(function)
        def call(*args: object, **kwargs: object) -> object:
            numbers = {name: x for name, x in kwargs.items() if name != "store"}  # whose attributes may hold anything
            if _checks.staged() or not _checks.concrete(args, numbers):
                raise TypeError(advice)
            try:
                return function(*args, **kwargs)
            except (ConcretizationTypeError, TracerArrayConversionError) as error:
                if _checks.outermost():
                    raise
                raise TypeError(advice) from error

        return call  # pyright: ignore[reportReturnType]

    return decorate


def compute(
    step: Step,
    states: State | MakeStates,
    dt: float | None,
    num_steps: int | None,
    *,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
    threads: int | None = None,
    same_bits: bool = True,
    earlier: Saves | None = None,
    **description: Any,
) -> Results:
    """The results of a run; states have the member axis also if it is of one body.

    Args:
        step, states, dt, num_steps, mesh, store, progress, resume, part, members, threads, same_bits: as in `li.run`.
        earlier: the saves in memory of a run that this one continues.
        description: further arguments of `checked_job`.
    """
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")
    k, count = (0, 1) if part is None else part_of_task() if part == "auto" else checked_part(part)
    threads = threads or (None if mesh is None else len(mesh.local_devices))
    mesh = _layout.checked_mesh(mesh)
    options = None if store is None else StoreOptions.of(store)
    in_parts, remote = part is not None and count > 1, options is not None and isinstance(address(options.path), Url)
    if (in_parts or remote) and _layout.count_processes(mesh) > 1:
        raise ValueError("part and stores in object storage are for independent processes, without jax.distributed")
    description |= {"dt": dt, "num_steps": num_steps, "store": store}
    made = made_states(states, members)
    with _checks.on_host():
        whole, job = make_jobs(step, states, made, (k, count) if in_parts else None, remote, description)
    engine = engine_of(job, mesh, threads or _layout.count_cores())

    with processes.name_lost(mesh):
        if options is None:
            if _layout.count_processes(mesh) > 1:
                _identity.check_processes(mesh, _identity.description(job, engine.name), store=None, resume=False)
            layout = _layout.layout_of(mesh, job.members)
            saves = execute(engine, layout, MemoryOutput(job, layout, earlier), progress)
            assert saves is not None
            return Results(job, engine.name, saves)
        saves = run_into_store(
            job,
            engine.name,
            options,
            lambda layout, output: execute(engine, layout, output, progress),
            whole=whole,
            mesh=mesh,
            part=(k, count) if in_parts else (0, 1),
            in_parts=in_parts or remote,
            resume=resume or part is not None,
            same_bits=same_bits,
        )
    return Results(job, engine.name, saves, str(options.path))


def write(job: Job, engine: str, saves: Saves, store: str | Path | StoreOptions) -> Saves:
    """The run of these saves, which an engine of this name computed, written into a new store: all of it or nothing."""
    options = StoreOptions.of(store)
    path = checked_path(options.path)
    if isinstance(path, Url):
        raise ValueError(f"a run is saved to a folder NAME.zarr; li.run(…, store={str(path)!r}) writes to a bucket")
    if path.exists():
        raise ValueError(f"{path.name} exists and is not overwritten: choose another path")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.zarr")
    try:
        hidden, mesh = options._replace(path=unfinished), _layout.checked_mesh(None)
        run_into_store(job, engine, hidden, partial(_feed, job, saves), whole=job, mesh=mesh)
        os.rename(unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return read_written(path)


def _feed(job: Job, saves: Saves, _: Layout, output: StoreOutput) -> None:
    """Give an output all saves of a run. Its checkpoints are of the end, for nobody resumes an unfinished copy."""
    rows, carry = rows_and_carry(job, saves)
    saved = 0
    while saved <= job.num_saves:
        number = min(output.free_rows, job.num_saves + 1 - saved)
        output.append(jax.tree.map(lambda x: np.asarray(x)[saved : saved + number], rows), number)  # noqa: B023
        saved += number
        output.checkpoint(carry, int(job.nodes[saved - 1]), 0.0, stop=False)
    output.result(carry)
