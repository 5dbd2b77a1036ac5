"""Writing a run that is in memory into a new store."""

from __future__ import annotations

import os
import shutil
from functools import partial
from pathlib import Path

import jax
import numpy as np

from lieint_jax.runs._job import devices
from lieint_jax.runs._job.engine import Engine
from lieint_jax.runs._job.job import Job
from lieint_jax.runs._job.memory_output import rows_and_carry
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.runs._storage.storage import StoreOptions, Url, checked_path
from lieint_jax.runs._storage.zipped import zip_folder
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._reading import read_written
from lieint_jax.runs.store._store_output import StoreOutput


def write(job: Job, engine: str, saves: Saves, store: str | Path | StoreOptions) -> Saves:
    """The run of these saves, which an engine of this name computed, written into a new store: all of it or nothing."""
    options = StoreOptions.of(store)
    path = checked_path(options.path, file=True)
    if isinstance(path, Url):
        raise ValueError(
            f"a run is saved to a folder NAME.zarr or a file NAME.zip; li.run(…, store={str(path)!r}) is for buckets"
        )
    if path.exists():
        raise ValueError(f"{path.name} exists and is not overwritten: choose another path")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.zarr")
    packed = unfinished.with_suffix(".zip")
    try:
        hidden, mesh = options._replace(path=unfinished), devices.checked_mesh(None)
        run_into_store(job, Engine(job, engine, 1), hidden, partial(_feed, job, saves), whole=job, mesh=mesh)
        if path.suffix == ".zip":
            zip_folder(unfinished, packed)
        os.rename(packed if path.suffix == ".zip" else unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        packed.unlink(missing_ok=True)
    return read_written(path)


def _feed(job: Job, saves: Saves, output: StoreOutput) -> None:
    """Give an output all saves of a run. Its checkpoints are of the end, for nobody resumes an unfinished copy."""
    rows, carry = rows_and_carry(job, saves)
    saved = 0
    while saved <= job.num_saves:
        number = min(output.free_rows, job.num_saves + 1 - saved)
        output.append(jax.tree.map(lambda x: np.asarray(x)[saved : saved + number], rows), number)  # noqa: B023
        saved += number
        output.checkpoint(carry, int(job.nodes[saved - 1]), 0.0, stop=False)
    output.result(carry)
