"""Functions of the states along a run: what a measurement is made of."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import PyTree, Vector3
from lieint_jax.core import State, Step, System
from lieint_jax.groups import so3, special_euclidean, special_orthogonal
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractManyBodies, AbstractMetricSystem, AbstractRotatingBody, Pendulum

Directions = ArrayLike | Callable[[Array], Array]  # one, one for each time, or a function of time


def system_of(run: Run) -> System:
    """The system of a run; ValueError if it is none, such as a trajectory of `integrate`."""
    if not isinstance(run, Run):
        raise ValueError(f"measurements need a run, as li.run(step, state, dt, num_steps) returns; got {type(run)}")
    return run.system


def map_run(run: Run, function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """The values of function(*arguments, step, state) along a run as a tree of arrays of JAX."""
    system_of(run)
    return run.map(Partial(function, *arguments))


def series_of(run: Run, function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """As `map_run`, as arrays of NumPy."""
    return jax.tree.map(np.asarray, map_run(run, function, *arguments))


def times_of(run: Run) -> np.ndarray:
    """The times of a run, (times,); ValueError of a batch whose step has its own time, each member another."""
    if run.members is not None and run.step.own_time:
        raise ValueError(f"with {run.step.name} each member has its own times: give one of them, run.member(k)")
    return np.asarray(run.t)


def count_bodies(run: Run) -> int:
    """The number of bodies of a run of several; ValueError if it is none."""
    if not isinstance(system_of(run), AbstractManyBodies):
        raise ValueError(f"the run must be of several bodies, systems.rigid_bodies(…); got {run.system!r}")
    return run.state.q.shape[-2]


def rotation(step: Step, state: State) -> Array:
    """The rotation from body to space, (3, 3), or of each of several bodies, (N, 3, 3)."""
    system, q = step.system, state.q
    if isinstance(system, AbstractRotatingBody):
        return system.rotation_matrix(state)
    if isinstance(system, AbstractManyBodies):
        return jax.vmap(so3.to_matrix)(q[:, 3:])
    if isinstance(system, AbstractMetricSystem) and system.group in (special_orthogonal(3), special_euclidean(3)):
        return q[:3, :3]
    raise ValueError(f"the system must be of rigid bodies, or on SO(3) or SE(3), which have attitudes; got {system!r}")


def rotate(R: Array, v: Array) -> Array:
    """Rv of matrices (…, 3, 3) and a vector, in full precision on GPUs too."""
    return jnp.sum(R * v, axis=-1)


def angular_momentum(step: Step, state: State) -> Vector3:
    """The total angular momentum in space, (3,); of several bodies about the origin."""
    system, q, p = step.system, state.q, state.p
    if isinstance(system, AbstractManyBodies):
        return jnp.sum(jnp.cross(q[:, :3], p[:, :3]) + p[:, 3:], axis=0)
    if isinstance(system, AbstractRotatingBody):
        return p if p.shape == (3,) else rotate(system.rotation_matrix(state), system.body_momentum(state))
    if isinstance(system, Pendulum):
        return p
    raise ValueError(f"the system must be of rigid bodies or a pendulum, which have angular momentum; got {system!r}")


def longitude(up: Vector3, a: Vector3) -> Array:
    """The angle of `a` about the unit vector `up`, in (−π, π]."""
    e1, e2 = frame(up)
    return jnp.arctan2(vectors.dot(e2, a), vectors.dot(e1, a))


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The angles between vectors (…, 3) of any length, accurate for small ones too."""
    a, b = (np.ldexp(x, -np.frexp(np.max(np.abs(x), axis=-1, keepdims=True))[1]) for x in (a, b))
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def directions(name: str, given: Directions, run: Run) -> Array:
    """Directions at the times of a run, (times, 3); (times, members, 3) of a function if each member has its own."""
    count = len(run.t)
    if callable(given):
        t = jnp.asarray(run.t if run.state.t is None else run.state.t)
        if t.ndim == 2 and _checks.concrete(t) and bool((t == t[:, :1]).all()):
            t = t[:, 0]  # the members share it
        _checks.function(name, given, "the time", (3,), t.ravel()[0])
        return jax.vmap(given)(t.ravel()).reshape(*t.shape, 3)
    found = _checks.real_array(name, given, (3,), (count, 3))
    return jnp.broadcast_to(found, (count, 3))


def principal_axes(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """The principal moments (3,), ascending, and axes in the body (columns of (3, 3), right-handed).

    Of members that have a step each with the member axis.
    """
    J = np.asarray(run.system.inertia, float)  # pyright: ignore[reportAttributeAccessIssue]
    moments, axes = np.linalg.eigh(J[..., None] * np.eye(3) if J.ndim == 1 + run.own_step else J)
    axes[..., 2] *= np.linalg.det(axes)[..., None]
    return moments, axes
