"""Runs read from their stores."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lieint_jax.ensemble import _opening, _store
from lieint_jax.ensemble._description import UnknownNameError, make
from lieint_jax.ensemble._integrity import Table
from lieint_jax.ensemble._job import Summary
from lieint_jax.types import System, Trajectory


def open_run(path: str | Path, own: Mapping[str, object] | None = None) -> tuple[Any, System]:
    """The run in a store, and its system, with which everything can be computed from it.

    Args:
        path: a folder NAME.zarr that `ensemble.run` or `lieint run` has written or is writing.
        own: classes and functions of the system that are not of this package, such as a potential of your own, by their
            names in the store. A name that is missing here is named by the error.

    Returns:
        What `ensemble.run` gives, as far as the run has come: a `Trajectory` of arrays on disk that are read when they
        are indexed, or a `Summary`; and the system, whose numbers are those of the store. With `step_axis=0` they carry
        the member axis.

    Raises:
        ValueError: no store, a damaged one (the message names the files), one of version 0.1, or a name that `own`
            should give.

    Example: the energies of all members at the end.

        run, system = li.ensemble.open("run.zarr")
        energies = jax.vmap(system.energy)(jax.tree.map(lambda x: x[-1], run.state))
    """
    path = Path(path)
    found, attributes = load_store(path)
    system = system_from_store(path, attributes, own)
    if isinstance(found, Trajectory) and len(found.t):
        _opening.check_system(path, system, found, attributes["run"]["step_axis"] == 0)
    if attributes["reduce"] is not None and not attributes["progress"]["complete"]:
        raise ValueError(f"{path} is a run with `reduce` that is not complete: resume it; xarray.open_zarr reads it")
    return _result(found, attributes), system


def load_store(path: Path) -> tuple[Any, Table]:
    """The complete part of the run in a store, checked, and the store's attributes; see `_store.load`."""
    _opening.check_store(path)
    with _opening.wrap_errors(path):
        return _store.load(path)


def system_from_store(path: Path, attributes: Table, own: Mapping[str, object] | None = None) -> System:
    """The system of the run in a store of these attributes."""
    constants = _store.constants(path, attributes["constants"])
    with _opening.wrap_errors(path, passed=(UnknownNameError,)):
        system = make(attributes["description"]["system"], constants, own or {})
        if not isinstance(system, System):
            raise ValueError("its description is that of no system")
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
