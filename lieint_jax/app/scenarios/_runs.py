"""Values of functions of the state along a run, and longer runs of one member, for reports and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from lieint_jax import ensemble
from lieint_jax.runs import integrate
from lieint_jax.types import State, Step, Trajectory
from lieint_jax.types.shapes import PyTree

Numbers: TypeAlias = Any  # a number of one member, or an array of the numbers of all, of JAX or of numpy

LONGEST, POINTS = 200_000, 4_000  # largest numbers of steps of a drawn run and of points of a curve

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


def member_state(run: Trajectory, m: int, time: int = 0) -> State:
    """The state of one member of a run at the saved time of index `time`."""
    return jax.tree.map(lambda x: jnp.asarray(x[time, m]), run.state)


def nominal_state(run: Trajectory, time: int = 0) -> State:
    """The state of member 0 of a run at the saved time of index `time`."""
    return member_state(run, 0, time)


def select_member(run: Trajectory, m: int) -> Trajectory:
    """The run of one member, as that of an ensemble of one."""
    state, info = jax.tree.map(lambda x: x[:, m : m + 1] if np.ndim(x) > 1 else x, (run.state, run.info))
    return Trajectory(run.t, state, info)


def nominal_member(tree: Any) -> Any:
    """Member 0 of a step or a system whose leaves have the member axis."""
    return jax.tree.map(lambda leaf: leaf[0], tree)


def series(function: Callable[..., Any], run: Trajectory, *given: Any) -> np.ndarray:
    """The values of a function of the arguments `given` and the state, at all saved times: (times, members, …).

    A function that is not a closure is compiled once for all arguments.
    """
    return np.asarray(_along_run(function, len(given))(*given, jax.tree.map(jnp.asarray, run.state)))


@lru_cache(maxsize=64)
def _along_run(function: Callable[..., Any], count: int) -> Callable[..., Any]:
    axes = (*[None] * count, 0)
    return jax.jit(jax.vmap(jax.vmap(function, axes), axes))


def over_members(function: Callable[[Any, State], Any], system: Any, run: Trajectory) -> Any:
    """The values of a function of system and state at all saved times, where each member has its own system."""
    each = jax.jit(jax.vmap(jax.vmap(function), in_axes=(None, 0)))
    return jax.tree.map(np.asarray, each(system, jax.tree.map(jnp.asarray, run.state)))


def map_on_local_devices(function: Callable[..., Any], axes: PyTree) -> Callable[..., Any]:
    """Map a function of one member over many, on the devices of this process: only the first process reports."""
    return ensemble.over_members(function, axes, Mesh(np.array(jax.local_devices()), ("members",)))


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The angles between vectors (…, 3), in degrees, accurate for small ones too."""
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def standard_deviation(x: np.ndarray) -> np.ndarray:
    """The standard deviation over the members, the first axis; 0 for a single member."""
    return np.std(x, axis=0, ddof=1) if len(x) > 1 else np.zeros(x.shape[1:])


def cached_for_last_run(function: Callable[[S, T, Trajectory], R]) -> Callable[[S, T, Trajectory], R]:
    """Store the value of a function for the last run, which the report and the pictures share."""
    last: list[tuple[Trajectory, R]] = []

    @wraps(function)
    def cached(scenario: S, step: T, run: Trajectory) -> R:
        if not (last and last[0][0] is run):
            last[:] = [(run, function(scenario, step, run))]
        return last[0][1]

    return cached


def drawn_steps(num_steps: int, longest: int = LONGEST) -> tuple[int, int]:
    """The number of steps of a drawn curve, at most `longest`, and its stride, for at most `POINTS` points."""
    num_steps = min(num_steps, longest)
    every = -(-num_steps // POINTS) or 1
    return max(num_steps // every, 1) * every, every


def drawn_trajectory(step: Step, state: State, dt: float, num_steps: int, longest: int = LONGEST) -> Trajectory:
    """Integrate from one state for a picture, at most `longest` steps, saved at the points to draw."""
    num_steps, every = drawn_steps(num_steps, longest)
    return _follow(step, state, dt, num_steps, save_every=every)


_follow = jax.jit(integrate, static_argnames=("num_steps", "save_every"))


def as_ensemble(run: Trajectory) -> Trajectory:
    """The trajectory of one member as that of an ensemble of one."""
    return Trajectory(run.t, *jax.tree.map(lambda x: np.asarray(x)[:, None], (run.state, run.info)))
