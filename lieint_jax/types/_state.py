"""States of phase space, reports of steps and trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax.types import _labeled
from lieint_jax.types._members import Axis, map_over_run
from lieint_jax.types._record import record
from lieint_jax.types.shapes import Flag, PyTree, Time


@record
class State(NamedTuple):
    """A point of phase space.

    Attributes:
        q: configuration. SO(3): unit quaternion (w, x, y, z), (4,); embedded in L(3): Λ, (3, 3). Matrix groups: (n, n).
            GL⁺(3): F, (3, 3). S²: unit vector, (3,).
        p: momentum. SO(3): spatial angular momentum π, (3,). Matrix groups: π in the dual basis, (d,). GL⁺(3): P,
            (3, 3). S²: π = m q × q̇, (3,).
        t: time, a scalar, of a system that is driven; else it may be None.
        work: what moving potentials and torques have done since the start, a scalar, or None if it is not tracked. The
            energy less the work is conserved.
        extra: arrays by name that a system or a scheme carries along, such as the momentum of a rotor, or None.

    What is None is no leaf of the pytree. Diagnostics that perturb a state leave t, work and extra as they are.
    """

    q: Array
    p: Array
    t: Array | None = None
    work: Array | None = None
    extra: dict[str, Array] | None = None

    def __repr__(self) -> str:
        return _labeled.fields(self)


@record
class StepInfo(NamedTuple):
    """The report of a step on the equation that it solved.

    Attributes:
        residual: norm of the implicit equation's residual, in the scheme's own dimensionless form.
        converged: the residual is round-off (within a multiple of eps·scale that each scheme states, 32 for those that
            solve an equation at each step) and the root lies on the scheme's branch. False wherever a result is not to
            be trusted; a NaN never comes without it.
    """

    residual: Array
    converged: Array

    def __repr__(self) -> str:
        return _labeled.fields(self)

    def merge(self, other: StepInfo) -> StepInfo:
        """The report of both: the larger residual, and whether both converged."""
        return StepInfo(jnp.maximum(self.residual, other.residual), self.converged & other.converged)

    @classmethod
    def fresh(cls, like: Array) -> StepInfo:
        """The report of no step yet, a scalar of the dtype of `like`."""
        return cls(jnp.zeros((), like.dtype), jnp.ones((), bool))


@record
class Trajectory(NamedTuple):
    """States at the saved times; every leaf has a leading time axis and entry 0 is the initial state.

    Attributes:
        t: times, shape (n+1,).
        state: the states.
        info: over the steps since the entry before: the largest residual, and whether all converged.
    """

    t: Array
    state: State
    info: StepInfo

    def __repr__(self) -> str:
        return _labeled.trajectory(self)

    def to_xarray(self, system: Any = None, units: Mapping[str, str] | None = None, system_axis: Axis = "auto") -> Any:
        """The trajectory as an `xarray.Dataset`, with the dimensions `time`, and `member` for a batch.

        Its variables are q, p, the other leaves that the states have (those of `extra` as extra_NAME), residual and
        converged. Quaternions have the dimension `quaternion` with labels w, x, y, z, vectors `axis` with x, y, z;
        several bodies have `body`, and `pose` (x, y, z, qw, qx, qy, qz) or `momenta` (px, py, pz, pix, piy, piz).

        Args:
            system: that of the run; adds energy and momentum_map, and angular_velocity (in body axes) where the system
                has one.
            units: by name of a variable or of the coordinate time, such as {"time": "d"}: the package knows none.
            system_axis: of a batch, None if all members have one system, 0 if each has its own, on the leading axis of
                the leaves (`step_axis=0` of `ensemble.run`); "auto" finds it by the shapes where they tell.

        Raises:
            ValueError: units of what is not there; shapes that contradict `system_axis`, or do not tell; a run whose
                axes are (member, time).
            ImportError: xarray is not installed.
        """
        return _labeled.dataset(self, system, units or {}, system_axis)

    def periods(self, body: Any, system_axis: Axis = "auto") -> Any:
        """The mean periods of a tumbling body along a run, precession, rotation and mode: `body.periods` of each state.

        Under torques they are those of the free motion that would go on from each state.

        Args:
            body: the system of the run, one with `periods`, such as `systems.rigid_body(…)`.
            system_axis: of a batch, as in `to_xarray`.

        Returns:
            `Periods`, arrays of shape (n+1,), or (n+1, members).

        Raises:
            ValueError: a system without periods; shapes that contradict `system_axis`, or do not tell.
        """
        if not hasattr(body, "periods"):
            raise ValueError(f"the system of the run must have periods, as bodies on T*SO(3) do; got {body!r}")
        return map_over_run(lambda own, z: own.periods(z), body, self, system_axis)

    def rotations(self) -> Any:
        """The attitudes, body to space, as `scipy.spatial.transform.Rotation` of shape (n+1, …).

        `.as_euler("ZXZ", degrees=True)` gives Euler angles of any sequence: capitals turn about the axes of the body,
        one after the other, small letters about those of space. Of a batch, scipy before 1.17 takes one member:
        `jax.tree.map(lambda x: x[:, k], (run.state, run.info))`.

        Raises:
            ValueError: q holds no quaternions.
        """
        return _labeled.rotations(self)


def counts_work(state: State) -> bool:
    """Whether a state counts work, in all or law by law."""
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
