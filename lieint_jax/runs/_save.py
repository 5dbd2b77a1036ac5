"""Writing a run that is in memory into a new store."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from lieint_jax.runs._engine import Engine
from lieint_jax.runs._memory_output import rows_and_carry
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._storage.leaves import Saves
from lieint_jax.runs._storage.storage import Url, checked_path
from lieint_jax.runs._storage.zipped import zip_folder
from lieint_jax.runs.store._into_store import run_into_store
from lieint_jax.runs.store._reading import read_written
from lieint_jax.runs.store._store_output import StoreOutput


def write(plan: Plan, engine: str, saves: Saves) -> Saves:
    """The run of these saves, which an engine of this name computed, written into a new store: all of it or nothing."""
    options = plan.store
    assert options is not None
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
        hidden = replace(plan, store=options._replace(path=unfinished))
        run_into_store(hidden, Engine(hidden, engine), partial(_feed, hidden, saves))
        if path.suffix == ".zip":
            zip_folder(unfinished, packed)
        os.rename(packed if path.suffix == ".zip" else unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        packed.unlink(missing_ok=True)
    return read_written(path)


def _feed(plan: Plan, saves: Saves, output: StoreOutput) -> None:
    """Give an output all saves of a run. Its checkpoints are of the end, for nobody resumes an unfinished copy."""
    rows, carry = rows_and_carry(plan, saves)
    saved = 0
    while saved <= plan.num_saves:
        number = min(output.free_rows, plan.num_saves + 1 - saved)
        output.append(jax.tree.map(lambda x: np.asarray(x)[saved : saved + number], rows), number)  # noqa: B023
        saved += number
        output.checkpoint(carry, int(plan.nodes[saved - 1]), 0.0, stop=False)
    output.result(carry)
