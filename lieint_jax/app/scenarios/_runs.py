"""Values of functions of the state along a run, and longer runs of one member, for reports and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from lieint_jax.plots.runs import POINTS, energy, kinetic_energy, momentum, positive, series
from lieint_jax.runs import Run, integrate, over_members
from lieint_jax.types import State, Step, Trajectory, vectors
from lieint_jax.types.shapes import PyTree

__all__ = ["POINTS", "energy", "kinetic_energy", "momentum", "positive", "series"]

Numbers: TypeAlias = Any  # a number of one member, or an array of the numbers of all, of JAX or of numpy

LONGEST = 200_000  # the largest number of steps of a drawn run

length: Callable[[Any], np.ndarray] = partial(np.linalg.norm, axis=-1)
angles = jax.jit(jnp.vectorize(vectors.angle, signature="(n),(n)->()"))  # between vectors (…, 3), in radians


def nominal_state(run: Run, time: int = 0, member: int = 0) -> State:
    """The state of a member, by default the nominal one, at the saved time of index `time`."""
    at_time = jax.tree.map(lambda x: x[time], run.state)
    return jax.tree.map(lambda x: jnp.asarray(x if run.members is None else x[member]), at_time)


def nominal_system(run: Run) -> Any:
    """The system of the nominal member."""
    return nominal_member(run.system) if run.own_step else run.system


def nominal_member(tree: Any) -> Any:
    """Member 0 of a tree whose leaves have the member axis."""
    return jax.tree.map(lambda leaf: leaf[0], tree)


def as_batch(run: Run) -> Run:
    """The run of one body as that of an ensemble of one."""
    state, info = jax.tree.map(lambda x: np.asarray(x)[:, None], (run.state, run.info))
    return Run.of(run.step, Trajectory(run.t, state, info), epoch=run.epoch)


def map_on_local_devices(function: Callable[..., Any], axes: PyTree) -> Callable[..., Any]:
    """Map a function of one member over many, on the devices of this process: only the first process reports."""
    return over_members(function, axes, Mesh(np.array(jax.local_devices()), ("members",)))


def standard_deviation(x: np.ndarray) -> np.ndarray:
    """The standard deviation over the members, the first axis; 0 for a single member."""
    return np.std(x, axis=0, ddof=1) if len(x) > 1 else np.zeros(x.shape[1:])


def drawn_steps(num_steps: int, longest: int = LONGEST) -> tuple[int, int]:
    """The number of steps of a drawn curve, at most `longest`, and its stride, for at most `POINTS` points."""
    num_steps = min(num_steps, longest)
    every = -(-num_steps // POINTS) or 1
    return max(num_steps // every, 1) * every, every


def drawn_run(step: Step, state: State, dt: float, num_steps: int, longest: int = LONGEST) -> Run:
    """Integrate from one state for a picture, at most `longest` steps, saved at the points to draw."""
    num_steps, every = drawn_steps(num_steps, longest)
    return Run.of(step, _follow(step, state, dt, num_steps, save_every=every))


_follow = jax.jit(integrate, static_argnames=("num_steps", "save_every"))
