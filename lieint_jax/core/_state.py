"""States of phase space, reports of steps and trajectories."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import concrete, dtype_of
from lieint_jax._numerics.arrays import Flag, PyTree, Time
from lieint_jax.core.record import record
from lieint_jax.core.text import named_fields_text

__all__ = [
    "State",
    "StepInfo",
    "Trajectory",
    "all_finite",
    "clock",
    "counts_work",
    "leaves_by_name",
    "state_from_leaves",
]

_EXTRA = "extra."  # begins the name of a leaf of `State.extra`: extra.NAME


@record
class State(NamedTuple):
    """A point of phase space.

    Attributes:
        q: configuration. SO(3): unit quaternion (w, x, y, z), (4,); embedded in L(3): Λ, (3, 3). Matrix groups: (n, n).
            GL⁺(3): F, (3, 3). S²: unit vector, (3,).
        p: momentum. SO(3): spatial angular momentum π, (3,). Matrix groups: π in the dual basis, (d,). GL⁺(3): P,
            (3, 3). S²: π = m q × q̇, (3,).
        t: time, a scalar. A driven system needs it; otherwise it may be None.
        work: the work of moving potentials and torques since the start, a scalar, or None if it is not tracked. Energy
            less work is conserved.
        extra: further arrays of the state of a system or a scheme, by name, such as the momentum of a rotor; or None.

    A field that is None is no leaf of the pytree. Diagnostics that perturb a state leave t, work and extra unchanged.
    """

    q: Array
    p: Array
    t: Array | None = None
    work: Array | None = None
    extra: dict[str, Array] | None = None

    def __repr__(self) -> str:
        return named_fields_text(self)


@record
class StepInfo(NamedTuple):
    """The report of a step: how well it solved its equation, and whether its result can be trusted.

    Attributes:
        residual: norm of the implicit equation's residual, in the scheme's own dimensionless form.
        converged: True if the residual is round-off (within a multiple of eps·scale that each scheme states, 32 for
            those that solve an equation at each step) and the root lies on the scheme's branch. It is False wherever a
            result is not to be trusted, and whenever the new state contains a NaN.
    """

    residual: Array
    converged: Array

    def __repr__(self) -> str:
        return named_fields_text(self)

    def merge(self, other: StepInfo) -> StepInfo:
        """The report of both: the larger residual, and whether both converged."""
        return StepInfo(jnp.maximum(self.residual, other.residual), self.converged & other.converged)

    @classmethod
    def of_root(cls, error: Array, good: Array, size: ArrayLike = 1) -> StepInfo:
        """The report of a root: converged if it is `good`, and its error is round-off of terms of that size, 32ε."""
        error = lax.stop_gradient(error)
        return cls(error, (error <= 32 * jnp.finfo(error.dtype).eps * lax.stop_gradient(size)) & good)

    @classmethod
    def empty(cls, like: Array) -> StepInfo:
        """The report of no step yet, a scalar of the dtype of `like`."""
        return cls(jnp.zeros((), like.dtype), jnp.ones((), bool))


@record
class Trajectory(NamedTuple):
    """States at the saved times; every leaf has a leading time axis and entry 0 is the initial state.

    `li.Run.of(step, trajectory)` answers the questions of a run: errors of energy and momentum, attitudes, tables.

    Attributes:
        t: times, shape (n+1,).
        state: the states.
        info: over the steps since the entry before: the largest residual, and whether all converged.
    """

    t: Array
    state: State
    info: StepInfo

    def __repr__(self) -> str:
        if dtype_of(self.t) is None or not concrete(self) or self.t.ndim != 1:
            return named_fields_text(self)
        members = "" if self.info.converged.ndim == 1 else f" of {self.info.converged.shape[1]} members"
        missed = int((~np.asarray(self.info.converged)).sum())
        fate = "all converged" if not missed else f"{missed} not converged"
        return (
            f"Trajectory({len(self.t)} entries{members}, t = {self.t[0]:.6g} … {self.t[-1]:.6g}, {fate}, {self.state})"
        )


def counts_work(state: State) -> bool:
    """Whether a state counts work, in total or law by law."""
    return state.work is not None or "works" in (state.extra or {})


def clock(state: State) -> Time:
    """The time of a state; ValueError if it has none."""
    if state.t is None:
        raise ValueError(
            "the system is driven, so its state needs the time: make it with system.state(..., t=0.0), or give it one "
            "with state._replace(t=0.0)"
        )
    return state.t


def all_finite(tree: PyTree) -> Flag:
    """Whether all arrays of a tree are finite, a scalar."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)]))


def leaves_by_name(state: State) -> dict[str, Any]:
    """The arrays of a state by the names that stores and files have for them: q, p, t, work, and extra.NAME."""
    own = {name: x for name, x in state._asdict().items() if name != "extra" and x is not None}
    return own | {f"{_EXTRA}{name}": x for name, x in (state.extra or {}).items()}


def state_from_leaves(arrays: dict[str, Any]) -> State:
    """The state of these arrays: the inverse of `leaves_by_name`."""
    extra = {name.removeprefix(_EXTRA): x for name, x in arrays.items() if name.startswith(_EXTRA)}
    own = {name: x for name, x in arrays.items() if not name.startswith(_EXTRA)}
    return State(**own, extra=extra or None)
