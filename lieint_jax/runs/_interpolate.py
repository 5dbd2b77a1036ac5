"""States between those of a trajectory, by Hermite interpolation on the phase space."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._xla import compiled
from lieint_jax.core import SpaceWithUnits, State, System, Trajectory, time_derivative
from lieint_jax.runs._clock import power_of_two
from lieint_jax.runs.members import axes

_T = TypeVar("_T")
_FEW = 64  # times in a trajectory of one body, which cost less than to compile again


def interpolate(system: System, trajectory: Trajectory, times: ArrayLike) -> State:
    """The states of a trajectory at any times inside it, for pictures.

    Between two saved states this is the quintic Hermite polynomial of their values and first and second derivatives, in
    coordinates of the phase space about the first state: those of exp on groups. So the result lies on the phase space.
    For saved states at intervals h its error is O(h⁶), in addition to that of the trajectory. It conserves no
    invariant; `integrate(…, save_at=…)` does, at the cost of one step for each time.

    Args:
        system: the system of the trajectory.
        trajectory: a trajectory of one body (use jax.vmap for several), with less than half a rotation between saved
            states.
        times: any times (m,) from the first to the last of `trajectory.t`, in any order.

    Returns:
        The states, every leaf with a leading axis (m,): NaN at traced times outside the trajectory, and beside a NaN.

    Raises:
        ValueError: concrete times outside the trajectory; a single entry; several members; too few saved states for
            interpolation.
    """
    if not isinstance(system, System):
        raise ValueError(f"system must be that of the trajectory, got a {type(system).__name__}")
    if len(axes(trajectory)) > 1:
        raise ValueError(
            f"the trajectory is of {np.shape(trajectory.info.residual)[1]} members, and interpolate accepts one: "
            "Trajectory(run.t, *jax.tree.map(lambda x: x[:, k], (run.state, run.info))), and the system of member k"
        )
    system.check(jax.tree.map(lambda x: x[0], trajectory.state))
    pairs = _pairs(trajectory, times)
    found, gaps = _of_any_number(_between_saves, system, pairs, _FEW)
    _refuse_gaps(gaps, pairs.time)
    return found


def interpolate_members(system: System, trajectory: Trajectory, times: ArrayLike, own_step: bool) -> State:
    """The states of the members of a batch at the same times, (times, member, …).

    Args:
        system: the system of the trajectory; with the member axis first if `own_step`.
        trajectory: a trajectory with the axes (time, member, …).
        times: as in `interpolate`; since the start, if the members start at different times.
        own_step: whether each member has a system of its own.
    """
    pairs = _pairs(trajectory, times)
    found, gaps = _of_any_number(partial(_of_members, own_step), system, pairs)
    _refuse_gaps(gaps, pairs.time)
    return found


class _Pair(NamedTuple):
    """Two neighboring saved states of a trajectory, each with its time, and a time, whether `inside` of it or not."""

    states: tuple[State, State]
    times: tuple[Array, Array]
    time: Array
    inside: Array


def _pairs(trajectory: Trajectory, times: ArrayLike) -> _Pair:
    """Those about each of these times, which are checked, every leaf with a leading axis."""
    wanted = _checks.real_array("times", times)
    xp: Any = np if concrete(trajectory.t, wanted) else jnp  # numpy compiles nothing
    t = xp.asarray(trajectory.t)
    wanted = xp.asarray(wanted).astype(t.dtype)
    if wanted.ndim != 1:
        raise ValueError(f"times must have shape (m,), got {wanted.shape}")
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(f"a trajectory of two entries or more is needed, got times of shape {t.shape}")
    sign = xp.where(t[-1] < t[0], -1, 1)
    inside = (sign * t[0] <= sign * wanted) & (sign * wanted <= sign * t[-1])
    if concrete(inside) and not np.all(np.asarray(inside)):
        first, last = sorted(np.asarray(t, float)[[0, -1]].tolist())
        raise ValueError(f"times must lie in the trajectory, from {first} to {last}, got {wanted}")
    left = xp.clip(xp.searchsorted(sign * t, sign * wanted, side="right") - 1, 0, len(t) - 2)
    states = jax.tree.map((np if concrete(trajectory, wanted) else jnp).asarray, trajectory.state)
    before, after = (jax.tree.map(lambda x: x[left + k], states) for k in (0, 1))  # noqa: B023
    return _Pair((before, after), (t[left], t[left + 1]), wanted, inside)


def _of_any_number(function: Callable[[System, _Pair], _T], system: System, pairs: _Pair, least: int = 2) -> _T:
    """The function of the pairs; for concrete ones, of any number up to `least`, or to a power of 2, by one program."""
    count = len(pairs.time)
    if not count or not _checks.stands_alone(system, pairs):
        return function(system, pairs)
    room = max(least, power_of_two(count))
    found = function(system, jax.tree.map(lambda x: np.resize(x, (room, *x.shape[1:])), pairs))
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[:count], found))


@partial(compiled, static_argnums=0)
def _of_members(own_step: bool, system: System, pairs: _Pair) -> tuple[State, Array]:
    axes = 0 if own_step else None, _Pair(1, None, None, None)  # pyright: ignore[reportArgumentType]
    return jax.vmap(_between_saves, axes, 1)(system, pairs)


def _refuse_gaps(gaps: Array, wanted: Array) -> None:
    """Raise ValueError if the saved states about a time are too far apart; where they are NaN, the result is NaN."""
    far = np.argwhere(np.asarray(gaps) >= 1) if concrete(gaps) else np.zeros(0)
    if far.size:
        k = int(far[0, 0])
        raise ValueError(
            f"the saved states about t = {float(wanted[k]):.6g} are too far apart to interpolate: their derivatives do "
            "not predict the next state; save more often"
        )


@compiled
def _between_saves(system: System, pairs: _Pair) -> tuple[State, Array]:
    """The states, and the relative error of the trapezoidal rule from one saved state to the next; ≥ 1 is too large."""
    space: Any = system.phase_space

    def interpolate_at(pair: _Pair) -> tuple[State, Array]:
        (a, b), (start, stop), time = pair.states, pair.times, pair.time
        h = stop - start
        rest, unravel = _raveled(a)

        def coordinates(z: State) -> Array:
            return jnp.concatenate([space.displacement(a, z), _raveled(z)[0] - rest])

        (_, v0, w0), (end, v1, w1) = (_jet(system, coordinates, z) for z in (a, b))
        part = (time - start) / jnp.where(h == 0, 1, h)  # 0 between two saves at one time
        d = _quintic(part, end, h * v0, h * v1, h * h * w0, h * h * w1)
        n = d.size - rest.size
        found = space.displaced(a, d[:n])._replace(**unravel(rest + d[n:]))
        found = found if a.t is None else found._replace(t=jnp.where(a.t == start, time, a.t + (time - start)))
        found = jax.tree.map(lambda x: jnp.where(pair.inside, x, jnp.nan), found)
        missed, moved = (jnp.abs(x)[: space.dim // 2 if a.p.size else None] for x in (h * (v0 + v1) / 2 - end, end))
        unit = space.units(a)[0] if isinstance(space, SpaceWithUnits) else 1  # lengths have one of their own
        return found, jnp.where(pair.inside, jnp.max(missed / (unit + moved)), 0)

    return jax.vmap(interpolate_at)(pairs)


def _raveled(state: State) -> tuple[Array, Callable[[Array], dict[str, Any]]]:
    """The work and the extra parts of a state as one array, and the function that separates them again."""
    flat, unravel = ravel_pytree({"work": state.work, "extra": state.extra})
    return flat.astype(state.p.dtype), unravel  # an empty one is float32


def _jet(system: System, function: Callable[[State], Array], state: State) -> tuple[Array, Array, Array]:
    """A function of the state, and its first and second time derivatives along the flow."""
    flow = partial(time_derivative, system)

    def rate(z: State) -> tuple[Array, Array]:
        return jax.jvp(function, (z,), (flow(z),))

    (value, first), (_, second) = jax.jvp(rate, (state,), (flow(state),))
    return value, first, second


def _quintic(s: Array, end: Array, v0: Array, v1: Array, w0: Array, w1: Array) -> Array:
    """The quintic from 0 at s = 0 to `end` at s = 1 with first derivatives v and second derivatives w."""
    u = 1 - s
    rises = s**3 * (10 - 15 * s + 6 * s * s)
    first = s * u**3 * (1 + 3 * s) * v0 - u * s**3 * (4 - 3 * s) * v1
    return rises * end + first + s * s * u * u / 2 * (u * w0 + s * w1)
