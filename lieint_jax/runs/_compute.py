"""Computing a run: in memory, or into a store; and writing one that is in memory."""

from __future__ import annotations

import contextlib
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import _checks
from lieint_jax.runs import _layout, processes
from lieint_jax.runs._clock import GridClock
from lieint_jax.runs._engine import engine_of
from lieint_jax.runs._execute import MemoryOutput, execute, rows_and_carry
from lieint_jax.runs._facts import Facts
from lieint_jax.runs._job import Job, MakeStates
from lieint_jax.runs._layout import Layout
from lieint_jax.runs._make_job import made_states, make_jobs
from lieint_jax.runs._part_of_task import checked_part, part_of_task
from lieint_jax.runs.store import _identity
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._leaves import Saves
from lieint_jax.runs.store._reading import read_written
from lieint_jax.runs.store._storage import StoreOptions, Url, address, checked_path
from lieint_jax.runs.store._store_output import StoreOutput
from lieint_jax.types import State, Step, callable_pytree


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
) -> tuple[Any, ...]:
    """Compute a run, and return the arguments of `run_of_saves`; states have the member axis also if it is of one body.

    Args:
        step, states, dt, num_steps, mesh, store, progress, resume, part, members, threads, same_bits: as in `li.run`.
        earlier: the saves in memory of a run that this one continues.
        description: further arguments of `checked_job`.
    """
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")
    k, count = (0, 1) if part is None else part_of_task() if part == "auto" else checked_part(part)
    threads = threads if threads is None else _checks.count("threads", threads, 1)
    given, mesh = mesh, _layout.checked_mesh(mesh)
    threads = threads or (_layout.count_cores() if given is None else len(mesh.local_devices))
    options = None if store is None else StoreOptions.of(store)
    in_parts, remote = part is not None and count > 1, options is not None and isinstance(address(options.path), Url)
    if (in_parts or remote) and _layout.count_processes(mesh) > 1:
        raise ValueError("part and stores in object storage are for independent processes, without jax.distributed")
    description |= {"dt": dt, "num_steps": num_steps, "store": store}
    made = made_states(states, members)
    with _checks.on_host():
        whole, job = make_jobs(step, states, made, (k, count) if in_parts else None, remote, description)
    engine = engine_of(job, mesh, threads)

    with processes.name_lost(mesh) if jax.process_count() > 1 else contextlib.nullcontext():
        if options is None:
            if _layout.count_processes(mesh) > 1:
                _identity.check_processes(mesh, _identity.description(job, engine.name), store=None, resume=False)
            layout = _layout.layout_of(mesh, job.members)
            saves = execute(engine, layout, MemoryOutput(job, layout, earlier), progress)
            assert saves is not None
            start = job.initial if job.reduction is not None else None
            functions = [None if f is None else callable_pytree(f) for f in (job.reduction, job.condition)]
            times = job.clock.times if isinstance(job.clock, GridClock) else None
            return job.step, saves, Facts.of_job(job, engine.name), start, *functions, times
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
    return job.step, saves, Facts.of_store(str(options.path), saves.attributes)


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
