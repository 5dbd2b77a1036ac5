"""Runs, read from their stores."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.ensemble import _part_reading, _store
from lieint_jax.ensemble._description import UnknownNameError, make
from lieint_jax.ensemble._integrity import Table
from lieint_jax.ensemble._job import Summary
from lieint_jax.ensemble._open_store import check_store
from lieint_jax.ensemble._part_reading import PublishedArray
from lieint_jax.ensemble._parts import PartsRoot, first_of, read_root
from lieint_jax.ensemble._storage import Address, address, open_storage
from lieint_jax.ensemble._untrusted import wrap_errors
from lieint_jax.types import System, Trajectory


def open_run(path: str | Path, own: Mapping[str, object] | None = None) -> tuple[Any, System]:
    """Open the run in a store, and rebuild its system, for energies and all other quantities.

    Args:
        path: a folder NAME.zarr, or a URL such as s3://bucket/NAME.zarr, that `ensemble.run` or `lieint run` has
            written or is writing.
        own: classes and functions of the system from outside this package, such as a custom potential, by their names
            in the store. If one is missing, the error message contains its name.

    Returns:
        The result of `ensemble.run` so far: a `Trajectory` of arrays on disk, which are read when they are indexed, or
        a `Summary`; and the system with the numbers in the store. With `step_axis=0` they have the member axis. In a
        store in parts, members of a missing or damaged part, and entries that a part has not reached, are NaN.

    Raises:
        ValueError: no store, a damaged one (the message lists the files), one of version 0.1, or a name missing in
            `own`.

    Warns:
        RuntimeWarning: parts that are missing, damaged or incomplete, by number. Objects in a bucket are not read for
            this: a damaged one raises an error when it is read, and `lieint info` checks each.

    Example: the energies of all members at the end.

        run, system = li.ensemble.open("run.zarr")
        energies = jax.vmap(system.energy)(jax.tree.map(lambda x: x[-1], run.state))
    """
    path = address(path)
    found, attributes = load_store(path)
    if attributes.get("missing"):
        warnings.warn(f"{path} is incomplete: {first_of(attributes['missing'])}", RuntimeWarning, stacklevel=2)
    system = system_from_store(path, attributes, own)
    if isinstance(found, Trajectory) and len(found.t):
        check_system(path, system, found, attributes["run"]["step_axis"] == 0)
    if attributes["reduce"] is not None and not attributes["progress"]["complete"]:
        raise ValueError(f"{path} is an incomplete run with `reduce`: resume it, or read it by xarray.open_zarr")
    return _result(found, attributes), system


def load_store(path: Address, thorough: bool | None = None) -> tuple[Any, Table]:
    """The complete part of the run in a store, checked, and the store's attributes; see `_store.load`.

    Args:
        path: the store.
        thorough: of a store in parts, look at every file; None does so on a disk.
    """
    if "parts" in check_store(path):
        storage = open_storage(path)
        root = read_root(storage)
        assert root is not None
        return _part_reading.load(PartsRoot(storage, root), not storage.is_remote if thorough is None else thorough)
    assert isinstance(path, Path)
    with wrap_errors(path):
        return _store.load(path)


def read_part(root: PartsRoot, k: int) -> Any:
    """The results of part k of a store, as `open_complete`."""
    return _result(*_part_reading.load(root, False, k))


def system_from_store(path: Address, attributes: Table, own: Mapping[str, object] | None = None) -> System:
    """The system of the run in a store of these attributes."""
    constants = _store.constants(path, attributes["constants"])
    with wrap_errors(path, passed=(UnknownNameError,)):
        system = make(attributes["description"]["system"], constants, own or {})
        if not isinstance(system, System):
            raise ValueError("its description is not that of a system")
        return system


def open_complete(path: Path) -> Any:
    """The run in a complete store: a `Trajectory` of arrays on disk, or a `Summary`."""
    return _result(*_store.load(path))


def _result(found: Any, attributes: Table) -> Any:
    if isinstance(found, Trajectory):
        return found
    state = _store.states_in(found, found["time"][-1], attributes)
    series = {name: found[name] for name in ("least", "greatest", "mean", "residual", "unconverged")}
    return Summary(found["time"], **series, state=state, failed=found["first_failure"])


def check_system(path: Address, system: System, run: Trajectory, own_system: bool) -> None:
    """Raise UnreadableError unless the run in a file has states of this system.

    Args:
        path: the file.
        system: the system; with the member axis on its numbers if `own_system`.
        run: the run.
        own_system: True if each member has a system of its own.
    """
    members = run.state.p.shape[1]
    with wrap_errors(path):
        if own_system and any(np.shape(leaf)[:1] != (members,) for leaf in jax.tree.leaves(system)):
            raise ValueError(f"its system does not have one value for each of its {members} members")
        m = run.state.p.first_published if isinstance(run.state.p, PublishedArray) else 0
        first = jax.tree.map(lambda x: x[m], system) if own_system else system
        state = jax.tree.map(lambda x: jnp.asarray(x[0, m]), run.state)
        first.check(state)
        if jax.eval_shape(lambda s, z: s.energy(z), first, state).shape != ():
            raise ValueError("the energy of its system is not defined for these states")
