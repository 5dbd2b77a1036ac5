"""Trajectories for other packages, as labeled arrays of xarray, tables of pandas and rotations of scipy."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.core import Trajectory
from lieint_jax.core import labels as laws_of
from lieint_jax.runs.members import axes

_BODIES = {  # by the name and the number of components of each body
    ("q", 7): ("pose", ["x", "y", "z", "qw", "qx", "qy", "qz"]),
    ("p", 6): ("momenta", ["px", "py", "pz", "pix", "piy", "piz"]),
}
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3))  # the structure constants of rotations in space
_COMPONENTS: dict[tuple[int, ...], tuple[str, list[str]]] = {
    (4,): ("quaternion", list("wxyz")),
    (3,): ("axis", list("xyz")),
}
_TEXTS = {
    "q": "configuration",
    "p": "momentum",
    "t": "time of each member",
    "work": "work done on the body",
    "extra_works": "work of each law",
    "residual": "largest residual since the last entry",
    "converged": "whether all steps since the last entry did",
}


def dataset(run: Trajectory, system: PyTree, units: Mapping[str, str], own_step: bool) -> Any:
    """An `xarray.Dataset` of a trajectory; see `Run.to_xarray`."""
    leading, arrays = axes(run), _arrays(run, system, own_step)
    labels: dict[str, PyTree] = {"time": np.asarray(run.t)}
    variables: dict[str, PyTree] = {}
    for name, x in arrays.items():
        dims, own = state_axes(name, x.shape[len(leading) :], system)
        labels |= own
        variables[name] = ((*leading, *dims), np.asarray(x), {"long_name": _TEXTS.get(name, name.replace("_", " "))})
    found = _package("xarray").Dataset(variables, labels)
    unknown = sorted(set(units) - set(found.variables))
    if unknown:
        names = [str(name) for name in found.variables]
        near = difflib.get_close_matches(unknown[0], names, 1) or [x for x in names if x.startswith(unknown[0])]
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"units of {', '.join(unknown)} are given, but the variables are {', '.join(names)}{meant}")
    for name, unit in units.items():
        found[name].attrs["units"] = unit
    return found


def _arrays(run: Trajectory, system: PyTree, own_step: bool) -> dict[str, Any]:
    """The arrays along a run by name, and the invariants of its system."""
    extra = {f"extra_{name}": x for name, x in (run.state.extra or {}).items()}
    leaves = {**run.state._asdict(), **extra, **run.info._asdict()}
    arrays = {name: x for name, x in leaves.items() if name != "extra" and x is not None}
    return arrays | _invariants(run, system, own_step)


def frame(run: Trajectory, system: PyTree, own_step: bool) -> Any:
    """A `pandas.DataFrame` of a trajectory: a row for each time and member, a column for each component."""
    leading = axes(run)
    shape = (len(run.t), *np.shape(run.info.residual)[1:])
    columns: dict[str, np.ndarray] = {"time": np.broadcast_to(np.reshape(run.t, (-1, *[1] * (len(shape) - 1))), shape)}
    if len(shape) > 1:
        columns["member"] = np.broadcast_to(np.arange(shape[1]), shape)
    for name, x in _arrays(run, system, own_step).items():
        dims, labels = state_axes(name, x.shape[len(leading) :], system)
        texts: list[Any] = [labels.get(dim, np.arange(n)) for dim, n in zip(dims, x.shape[len(leading) :], strict=True)]
        for where in np.ndindex(x.shape[len(leading) :]):
            text = "_".join([name, *(str(own[k]) for own, k in zip(texts, where, strict=True))])
            columns[text] = np.asarray(x)[(..., *where)]
    return _package("pandas").DataFrame({name: np.ravel(x) for name, x in columns.items()})


def rotations(run: Trajectory) -> Any:
    """The attitudes of a trajectory as `scipy.spatial.transform.Rotation`; see `Run.rotations`."""
    q = np.asarray(run.state.q)
    own = q.shape[len(axes(run)) :]
    if own == (3, 3):
        raise ValueError(
            "q holds matrices that need not be rotations: scipy's Rotation.from_matrix returns the nearest ones"
        )
    if own != (4,) and not (len(own) == 2 and own[1] == 7):
        raise ValueError(f"attitudes are quaternions, q of shape (…, 4), or (…, N, 7) for N bodies; got {q.shape}")
    transform = _package("scipy.spatial.transform")
    return transform.Rotation.from_quat(np.roll(q[..., -4:], -1, axis=-1))


def state_axes(
    name: str, shape: tuple[int, ...], system: PyTree = None
) -> tuple[tuple[str, ...], dict[str, np.ndarray | list[str]]]:
    """Names of the axes of one state's array, and their labels; the system provides some of them."""
    if name == "extra_works" and len(shape) == 1:
        names = [] if system is None else laws_of(system)
        return ("law",), {"law": names} if len(names) == shape[0] else {}
    if name in ("q", "p", "angular_velocity") and shape in _COMPONENTS and _has_axes(system):
        dim, own = _COMPONENTS[shape]
        return (dim,), {dim: own}
    if len(shape) == 2 and (name, shape[1]) in _BODIES and _has_axes(system):
        dim, own = _BODIES[name, shape[1]]
        return ("body", dim), {"body": np.arange(shape[0]), dim: own}
    if len(shape) == 2 and name in ("q", "p"):
        return ("row", "column"), {}
    return tuple(f"{name}_component{k or ''}" for k in range(len(shape))), {}


def _has_axes(system: PyTree) -> bool:
    """Whether components may belong to axes of space: on matrix groups other than rotations they are of the basis."""
    match system:
        case object(group=object(structure=structure)):
            return structure.shape == _CROSS.shape and np.allclose(structure, structure[0, 1, 2] * _CROSS)
    return True


def _invariants(run: Trajectory, system: PyTree, own_step: bool) -> dict[str, Array]:
    """Energy, momentum map, and the angular velocity in the body, where the system has them."""
    kind = type(system)
    functions = {"energy": kind.energy} if system.hamiltonian else {}
    functions["momentum_map"] = kind.momentum
    if hasattr(system, "angular_velocity"):
        functions["angular_velocity"] = kind.angular_velocity

    states, batch = jax.tree.map(jnp.asarray, run.state), len(axes(run)) > 1

    def along_run(function: Callable[[PyTree, PyTree], Array]) -> Array:
        of_members = jax.vmap(function, (0 if own_step else None, 0)) if batch else function
        return jax.jit(jax.vmap(of_members, (None, 0)))(system, states)

    measured = {name: along_run(function) for name, function in functions.items()}
    return {name: x for name, x in measured.items() if x.size}


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(f"{package} is not installed: pip install {package}") from error
