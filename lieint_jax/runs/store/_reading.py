"""Runs, read from their stores."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax.core import Step, System, Trajectory, pytree, static
from lieint_jax.runs._loop import Change
from lieint_jax.runs._storage.arrays import StoredArray, first_of
from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.leaves import Saves, Table, states_in, step_array
from lieint_jax.runs._storage.storage import Address
from lieint_jax.runs._storage.untrusted import wrap_errors
from lieint_jax.runs._summary import SERIES, MemberSummary, Summary
from lieint_jax.runs.store import _published
from lieint_jax.runs.store._description import UnknownNameError, make
from lieint_jax.runs.store._published import PublishedArray
from lieint_jax.runs.store._root import PartState, Root, check_store, written_root

_T = TypeVar("_T")


def open_with_step(path: Address, own: Mapping[str, object] | None = None) -> tuple[Saves, Step]:
    """The run in a store and its step; arguments and errors as in `li.open`."""
    stored = read_run(path)
    system = system_from_store(path, stored.attributes, own)
    step = _from_store(path, stored.attributes, "step", Step, own, system)
    _check_states(path, step.system, stored)
    return stored, step


def read_run(path: Address) -> Saves:
    """The run in a store, checked as far as its arrays show."""
    loaded = _load(path)
    found, attributes = loaded.found, loaded.attributes
    if attributes.get("missing"):
        warnings.warn(f"{path} is incomplete: {first_of(attributes['missing'])}", RuntimeWarning, stacklevel=3)
    if not isinstance(found, Trajectory) and not attributes["progress"]["complete"]:
        raise ValueError(f"{path} is an incomplete run with `reduce`: resume it, or read it by xarray.open_zarr")
    with wrap_errors(path):
        return _as_stored(loaded)


def _check_states(path: Address, system: System, stored: Saves) -> None:
    if isinstance(stored.found, Trajectory) and len(stored.found.t):
        check_system(path, system, stored.found, stored.attributes["run"]["own_step"])


def load_store(path: Address, thorough: bool | None = None) -> tuple[Any, Table]:
    """The published part of the run in a store, checked, and the store's attributes.

    It is a `Trajectory` of arrays that are read where they are indexed, or the arrays of a reduced run by name.

    Args:
        path: the store.
        thorough: of a store in parts, look at every file; None does so on a disk.

    Raises:
        ValueError: the store is damaged (the message names the file and what can still be read), or there is none.
    """
    loaded = _load(path, thorough)
    return loaded.found, loaded.attributes


def _load(path: Address, thorough: bool | None = None) -> Saves:
    root = check_store(path)
    with wrap_errors(path):
        return _published.load(root, not root.storage.is_remote if thorough is None else thorough)


def read_part(root: Root, k: int, progress: Table) -> Saves:
    """The run of part k of a store, which this process has written up to this progress."""
    return _as_stored(_published.load(root, False, (k, PartState(progress, {}))))


def read_written(path: Path) -> Saves:
    """The run in a store that this process has just written."""
    root = written_root(open_storage(path))
    return read_part(root, 0, root.attributes["progress"])


def system_from_store(path: Address, attributes: Table, own: Mapping[str, object] | None = None) -> System:
    """The system of the run in a store of these attributes."""
    return _from_store(path, attributes, "system", System, own)


def step_from_store(path: Address, attributes: Table) -> Step:
    """The step of the run in a store of these attributes; that of a user's own scheme can only be asked its system."""
    system = system_from_store(path, attributes)
    try:
        return _from_store(path, attributes, "step", Step, None, system)
    except UnknownNameError:
        return _StepOfUser(system)


@pytree
class _StepOfUser(Step):
    """Stands for a step whose class is not in this package."""

    system: System
    order: float = static(default=1)
    symmetric: bool = static(default=False)

    @property
    def name(self) -> str:
        return "a step of the user's"


def _from_store(
    path: Address,
    attributes: Table,
    what: str,
    kind: type[_T],
    own: Mapping[str, object] | None,
    system: System | None = None,
) -> _T:
    """The step, with this system, or the system of the run in a store."""
    storage = open_storage(path)
    constants = {name: StoredArray.open(storage, step_array(name)).read() for name in attributes["constants"]}
    with wrap_errors(path, passed=(UnknownNameError,)):
        found = make(attributes["description"][what], constants, own or {}, system)
        if not isinstance(found, kind):
            raise ValueError(f"its description is not that of a {what}")
        return found


def _as_stored(loaded: Saves) -> Saves:
    """The run with a summary of the arrays of a reduced one, and with the first failures as far as reports show them.

    Before the run is complete, these are the first steps between two of its saves.
    """
    found, failed, attributes = loaded
    if isinstance(found, Trajectory):
        failed = _failures(found, attributes["save_every"]) if failed is None else failed
        return Saves(found, failed, attributes)
    state, failed = states_in(found, found["time"][-1], attributes), found["first_failure"]
    if attributes["per"] is not None:
        names = (*Change._fields, "residual", "unconverged")
        values: dict[str, Any] = {name: found.get(name) if name == "first" else found[name] for name in names}
        number = attributes["num_steps"] + 1
        return Saves(
            MemberSummary(found["time"], **values, number=number, state=state, failed=failed), failed, attributes
        )
    series = {name: found[name] for name in SERIES}
    return Saves(Summary(found["time"], **series, state=state, failed=failed), failed, attributes)


def _failures(found: Trajectory, save_every: int | None) -> np.ndarray:
    """The first step of the first save interval in which a step of each member failed, or −1, from the reports."""
    converged = found.info.converged
    if not len(found.t):
        return np.full(np.shape(converged)[1], -1)
    bad = ~np.asarray(converged[...])
    if isinstance(converged, PublishedArray):
        bad &= converged.published
    first = np.maximum(bad.argmax(axis=0) - 1, 0) * (save_every or 1)
    return np.where(bad.any(axis=0), first, -1)


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
