"""The times of the steps of a run: steps of one size, between given times, or as the step chooses; and of its saves."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.core import State, Step, converges, counts_work


def _times(n: ArrayLike, dt: Array) -> Array:
    """n Δt, also where JAX does not promote integers."""
    if isinstance(n, int):
        return n * dt
    n = n.astype(dt.dtype) if isinstance(n, np.ndarray) else jnp.asarray(n, dt.dtype)
    return n * dt  # pyright: ignore[reportReturnType]  # numpy's on the host


class UniformClock(NamedTuple):
    """Steps of one size, or, with `coarse`, of one size up to rounding.

    A step that counts work evaluates the energies of time-dependent laws at its two ends, t and t + size. If the next
    step does not begin at t + size to the last bit, neither step counts the change of energy in between: a rounding
    error in every step, which has the same sign for many steps. With `coarse` the size of each step is the difference
    of the rounded times of its two nodes.

    Attributes:
        t0: the time of the first; None if the steps advance the time of the state themselves, by sizes in a fictitious
            time.
        dt: their size.
        coarse: dt rounded to half of its digits: products with it and with the rest are exact, so that the time of a
            node has the same bits wherever it is computed, with or without a fused multiply-add. Or None.
    """

    t0: Array | None
    dt: Array
    coarse: Array | None = None

    @classmethod
    def rounded(cls, t0: Array | None, dt: Array) -> UniformClock:
        """The clock of steps of size dt from the time t₀, up to rounding."""
        precision = jnp.finfo(dt.dtype)
        return cls(t0, dt, lax.stop_gradient(lax.reduce_precision(dt, precision.nexp, precision.nmant // 2)))

    def size(self, n: ArrayLike) -> Array:
        """The size of the step from node n; its derivative is that of dt."""
        if self.coarse is None:
            return self.dt
        return self.dt + lax.stop_gradient(self.time(n + 1) - self.time(n) - self.dt)

    def time(self, n: ArrayLike) -> Any:
        """The time of node n, where a sum of n sizes would have the rounding errors of all; None without t₀."""
        if self.t0 is None:
            return None
        if self.coarse is None:
            return self.t0 + _times(n, self.dt)
        return self.t0 + _times(n, self.coarse) + _times(n, self.dt - self.coarse)

    def with_room(self) -> UniformClock:
        """The clock itself, which has room for any number of steps."""
        return self

    def node(self, t: Array, num_steps: ArrayLike) -> Array:
        """The last node that is not after the time t."""
        assert self.t0 is not None
        n = lax.stop_gradient((t - self.t0) / self.dt)
        near = jnp.round(n)
        at_node = jnp.abs(t - self.time(near)) <= 4 * jnp.finfo(t.dtype).eps * jnp.abs(t)
        return jnp.clip(jnp.where(at_node, near, jnp.floor(n)), 0, jnp.asarray(num_steps, n.dtype)).astype(int)


class GridClock(NamedTuple):
    """Steps from one given time to the next.

    Attributes:
        times: the times of all nodes, (N+1,).
    """

    times: Array

    def size(self, n: ArrayLike) -> Array:
        """The size of the step from node n."""
        return self.times[n + 1] - self.times[n]

    def time(self, n: ArrayLike) -> Array:
        """The time of node n."""
        return self.times[n]

    def node(self, t: Array, num_steps: ArrayLike) -> Array:
        """The last node that is not after the time t."""
        sign = jnp.where(self.times[-1] < self.times[0], -1, 1)
        after = jnp.searchsorted(sign * self.times, sign * t, side="right")
        return jnp.clip(after - 1, 0, num_steps)

    def with_room(self) -> GridClock:
        """The clock with a power of 4 of times, so that runs share programs: copies of the last follow."""
        missing = 4 ** max(4, math.ceil(math.log(len(self.times), 4))) - len(self.times)
        return GridClock(np.pad(np.asarray(self.times), (0, missing), "edge"))  # pyright: ignore[reportArgumentType]


Clock = UniformClock | GridClock
MOST_COUNTED = np.iinfo(np.int32).max  # steps of a loop whose number of steps is an argument, or to output times
MOST_TRACED = 2**31 - 128  # steps to traced output times: the largest number below it that float32 has too
_HALVINGS = 20  # the most that `more_times` tries


def clock_of(
    step: Step, state: State, dtype: Any, dt: ArrayLike | None, num_steps: int | None, times: npt.ArrayLike | None
) -> tuple[Clock, int]:
    """The clock of a run from a state, and the number of steps."""
    if times is None:
        if num_steps is None:
            raise ValueError("give dt and num_steps, or times")
        size = _checks.as_array(_checks.step_size(dt), dtype)
        return uniform_clock(step, state, size), _checks.count("num_steps", num_steps, 0)
    refuse_times(step, "times")
    if dt is not None or num_steps is not None:
        raise ValueError("give dt and num_steps, or times, not both")
    nodes = _checks.real_array("times", times).astype(dtype)
    if nodes.ndim != 1 or not nodes.size:
        raise ValueError(f"times must have shape (N+1,), N steps, got {nodes.shape}")
    if concrete(nodes):
        sizes = np.diff(np.asarray(nodes))
        if not (np.all(sizes > 0) or np.all(sizes < 0)):
            n = int(np.argmax(sizes * np.sign(sizes[0]) <= 0))
            raise ValueError(f"times must increase, or decrease, from one to the next, got {nodes[n : n + 2]} at {n}")
    if state.t is not None and concrete(nodes, state.t) and float(nodes[0]) != float(state.t):
        first = float(nodes[0])
        raise ValueError(
            f"times must begin at the time of the state, {float(state.t)}, got {first}; begin there, or make the "
            f"state at that time: system.state(..., t={first})"
        )
    return GridClock(nodes), nodes.size - 1


def uniform_clock(step: Step, state: State, dt: Array) -> UniformClock:
    """The clock of steps of size dt from a state; of a state without a time, since the start."""
    if step.own_time:
        return UniformClock(None, dt)
    t0 = _checks.as_array(0.0, dt.dtype) if state.t is None else state.t
    return UniformClock.rounded(t0, dt) if counts_work(state) and not step.prepares else UniformClock(t0, dt)


def intervals(num_steps: int, save_every: int | None) -> tuple[int, int]:
    """The number of steps between saved states (None: all steps) and of saved states after the initial one."""
    num_steps = _checks.count("num_steps", num_steps, 0)
    save_every = max(num_steps, 1) if save_every is None else _checks.count("save_every", save_every, 1)
    return save_every, saves(num_steps, save_every)


def power_of_two(rows: int) -> int:
    """The rows for which a program has room: the least power of two, or 2, so that runs share programs."""
    return 1 << max(1, (rows - 1).bit_length())


def saves(num_steps: int, save_every: int) -> int:
    """The number of saved states after the initial one; ValueError if `save_every` does not divide `num_steps`."""
    if num_steps % save_every:
        near = _checks.nearest_multiples(num_steps, save_every)
        raise ValueError(f"num_steps = {num_steps} is not a multiple of save_every = {save_every}; use {near} steps")
    return num_steps // save_every


class HalvedRuns:
    """The runs of finite order that were traced in `halved_steps`.

    Attributes:
        orders: the orders of their steps.
    """

    def __init__(self) -> None:
        self.orders: list[float] = []


_context = jax.make_user_context(None)  # part of the key of every jit cache: jitted functions are traced again


@contextlib.contextmanager
def halved_steps() -> Iterator[HalvedRuns]:
    """A context in which `integrate` and `event` split every step into two."""
    runs = HalvedRuns()
    with _context(runs):
        yield runs


def splits(step: Step) -> int:
    """Into how many steps a run splits each step: 2 in `halved_steps`, otherwise 1.

    Exact steps are not split, nor are those with noise, which half the size would change.
    """
    if _context.value is None or math.isinf(step.order) or step.deterministic is not None:
        return 1
    _context.value.orders.append(float(step.order))
    return 2


def halved(clock: Clock) -> Clock:
    """The clock of two steps for each of this one's."""
    if isinstance(clock, GridClock):
        middles = (clock.times[1:] + clock.times[:-1]) / 2
        return GridClock(jnp.concatenate([clock.times[:1], jnp.stack([middles, clock.times[1:]], 1).ravel()]))
    half = clock.dt / 2
    return UniformClock(clock.t0, half) if clock.coarse is None else UniformClock.rounded(clock.t0, half)


def more_times(step: Step, state: State, size: ArrayLike) -> str:
    """The remedy, after a step's advice, where a step fails whose `size` comes from given times."""
    for k in range(1, _HALVINGS + 1):
        if bool(converges(step, state, jnp.asarray(size) / 2**k)):
            return (
                f". Here dt is what `times` are apart, {float(jnp.abs(size)):.3g}, and a step of 1/{2**k} of it "
                f"converges: give about {2**k} times as many times"
            )
    return ""


def outputs(save_at: npt.ArrayLike, clock: Clock, num_steps: int, dtype: Any, *, ordered: bool = True) -> Array:
    """The output times; ValueError if concrete ones are outside the run, or out of order where they are `ordered`."""
    wanted = _checks.real_array("save_at", save_at).astype(dtype)
    if wanted.ndim != 1:
        raise ValueError(f"save_at must have shape (m,), got {wanted.shape}; use jax.vmap for batches")
    if concrete(wanted, clock):
        first, last = float(clock.time(0)), float(clock.time(num_steps))
        ahead = (np.asarray(wanted, float) - first) * (1 if last >= first else -1)
        if ordered and np.any(np.diff(ahead) < 0):
            raise ValueError(f"save_at must be in the order of the run, from {first} to {last}, got {wanted}")
        if np.any(ahead < 0) or np.any(ahead > abs(last - first) + _rounding(np.asarray(wanted), first)):
            raise ValueError(f"save_at must lie in the run, from {first} to {last}, got {wanted}")
    return wanted


def is_inside(t: Array, clock: Clock, num_steps: ArrayLike) -> Array:
    """Whether output times, which may be traced, lie in a run, up to rounding; a time that is not finite does not."""
    first, last = clock.time(0), clock.time(num_steps)
    ahead, rounding = jnp.where(last < first, first - t, t - first), _rounding(t, first)
    return jnp.isfinite(t) & (ahead >= -rounding) & (ahead <= jnp.abs(last - first) + rounding)


def _rounding(t: Any, first: ArrayLike) -> Any:
    """By how much a time may be off that was computed in another way than the clock's, such as by a sum."""
    return 1e-12 * abs(t - first) + 4 * float(jnp.finfo(t.dtype).eps) * abs(t)


def steps_to_reach(save_at: npt.ArrayLike, start: ArrayLike | None, dt: ArrayLike, dtype: Any) -> int | None:
    """The number of steps of size dt from the time `start` that leads to or beyond all output times.

    None if one of the times or dt is traced.
    """
    size, start = _checks.step_size(dt), 0.0 if start is None else start
    wanted = _checks.real_array("save_at", save_at)
    if not concrete(wanted, size, start):
        return None
    h, t0, t = (np.asarray(x).astype(dtype).astype(float) for x in (size, start, wanted))
    if not h:
        raise ValueError("dt must not be 0: no number of steps leads to other times")
    ahead = (t - t0) / h
    if np.any(ahead < 0):
        raise ValueError(
            f"save_at must lie on the side of the start, t = {start}, that dt = {dt} leads to, got {wanted}"
        )
    most = float(np.max(ahead, initial=0))
    refuse_far_times("save_at", most, start)
    return int(most) + 1


def refuse_far_times(name: str, steps: float, start: ArrayLike) -> None:
    """ValueError if more steps lead to output times than a run can count."""
    if steps >= MOST_COUNTED:
        raise ValueError(
            f"{name}: {steps:.3g} steps lead there from the start, and {MOST_COUNTED} are too many. Times "
            f"count from t = {start}, that of the state, or 0 if it has none: make the state at their epoch, "
            "system.state(..., t=…), or subtract the epoch from them; otherwise give a larger dt, or several runs"
        )


def refuse_times(step: Step, given: str) -> None:
    """ValueError if a step advances the time itself, so that no time can be given to it."""
    if step.own_time:
        raise ValueError(
            f"{given} cannot be given to {step.name}, which chooses its times itself: compute the state at a time T by "
            "li.event(step, state, dt, lambda z: z.t - T, max_steps=…)"
        )


def at_time(state: State, t: Array | None) -> State:
    """`state` at the time t, if it has a time and t is one."""
    return state if state.t is None or t is None else state._replace(t=t)
