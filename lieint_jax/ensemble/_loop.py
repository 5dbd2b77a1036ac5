"""The compiled loop that advances a batch, and its carry."""

from __future__ import annotations

import platform
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax.types import State, Step, StepInfo, energy_less_work, on_clock

Reduction = Callable[[Step, State], Array]


class Range(NamedTuple):
    """The least, the greatest and the sum of a quantity over the steps since the last save, one of each per member."""

    least: Array
    greatest: Array
    total: Array

    @classmethod
    def fresh(cls, like: Array) -> Range:
        """The range of no steps yet."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), jnp.zeros_like(like))

    def including(self, x: Array) -> Range:
        """This range with one more value per member; a NaN shows in all three."""
        return Range(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x)


class Carry(NamedTuple):
    """The carry of a run from one step to the next, every leaf with the member axis first.

    Attributes:
        state: the states, without their time, which follows from the number of steps unless the step has its own.
        info: the merged `StepInfo` since the last save.
        failed: the first step that did not converge, or −1.
        change: the range of the reduced quantity's change since the last save; None if nothing is reduced.
    """

    state: State
    info: StepInfo
    failed: Array
    change: Range | None


class Origin(NamedTuple):
    """What a run begins with, and its loop refers to at every step.

    Attributes:
        t0: the time of the initial states: a scalar if the members share it, else one for each; None if they have none,
            or the step has its own, which then is part of the state.
        quantity: the reduced quantity of the initial states; None if nothing is reduced.
    """

    t0: Array | None
    quantity: Array | None


class Portion(NamedTuple):
    """The part of a run that one call of the compiled loop does: `saves` times `every` steps of size `dt`.

    Attributes:
        dt: the step size, an array of the states' dtype.
        done: the number of steps taken before.
        saves: the number of save intervals.
        every: the number of steps in each.
        fresh: True if a save interval begins here; False if the call continues one, whose report is in the carry.
    """

    dt: Any
    done: Any
    saves: Any
    every: Any
    fresh: Any


def compiler_options() -> dict[str, Any]:
    """XLA's options for the compiled loops: 512-bit vectors on x86, 1.4 to 1.7 times faster on AVX-512 machines."""
    on_x86 = jax.default_backend() == "cpu" and platform.machine().lower() in ("x86_64", "amd64")
    return {"xla_cpu_prefer_vector_width": 512} if on_x86 else {}


def step_dtype() -> Any:
    """The dtype of step counts: int64, or int32 without x64."""
    return jax.dtypes.canonicalize_dtype(np.int64)


@cache
def start(step_axis: int | None, reduction: Reduction | None) -> Callable[..., tuple[Carry, Origin]]:
    """(step, states without their time, t0) ↦ the carry of a run and its origin."""

    def begin(step: Step, states: State, t0: Array | None) -> tuple[Carry, Origin]:
        members = states.p.shape[0]
        info = StepInfo(jnp.zeros(members, states.p.dtype), jnp.ones(members, bool))
        quantity = None if reduction is None else _over_members(reduction, step_axis, step, _timed(states, t0))
        change = None if quantity is None else Range.fresh(quantity)
        failed = jnp.full(members, -1, step_dtype())
        return Carry(states, info, failed, change), Origin(t0, quantity)

    return jax.jit(begin, compiler_options=compiler_options())


@cache
def prepare(step_axis: int | None) -> Callable[..., Any]:
    """(step, states without their time, t0, dt) ↦ the prepared steps, with the member axis on every leaf."""

    def prepared(step: Step, states: State, t0: Array | None, dt: Array) -> Step:
        return _over_members(lambda s, z: s.prepare(z, dt), step_axis, step, _timed(states, t0))

    return jax.jit(prepared, compiler_options=compiler_options())


@cache
def advance(step_axis: int | None, reduction: Reduction | None, buffer_rows: int) -> Callable[..., tuple[Carry, Any]]:
    """The compiled loop (step, carry, origin, portion) ↦ (carry, saved), for at most `buffer_rows` saves a call.

    Each row of `saved` holds the report, and the state or the change of the reduced quantity since `origin`.
    """

    def loop(step: Step, carry: Carry, origin: Origin, portion: Portion) -> tuple[Carry, Any]:
        dt, done, saves, every, fresh = portion
        unsaved = _unsaved(carry)

        def at(n: ArrayLike, state: State) -> State:
            return on_clock(state, origin.t0, done + n, dt)

        def one_step(step: Step, state: State) -> tuple[State, StepInfo]:
            state, info = step(state, dt)
            return state if origin.t0 is None else state._replace(t=None), info

        def one(n: Array, carry: Carry) -> Carry:
            state, info = _over_members(one_step, step_axis, step, at(n, carry.state))
            failed = jnp.where((carry.failed < 0) & ~info.converged, n, carry.failed)
            change = carry.change
            if reduction is not None and change is not None and origin.quantity is not None:
                change = change.including(_over_members(reduction, step_axis, step, at(n + 1, state)) - origin.quantity)
            return Carry(state, carry.info.merge(info), failed, change)

        def interval(k: Array, loop: tuple[Carry, Any]) -> tuple[Carry, Any]:
            carry, saved = loop
            begins = (k > 0) | fresh
            info, change = jax.tree.map(
                lambda new, old: jnp.where(begins, new, old), unsaved, (carry.info, carry.change)
            )
            carry = carry._replace(info=info, change=change)
            carry = lax.fori_loop(0, every, lambda i, c: one(k * every + i, c), carry)
            return carry, jax.tree.map(lambda to, x: to.at[k].set(x), saved, _saved(carry))

        buffer = jax.tree.map(lambda x: jnp.zeros((buffer_rows, *x.shape), x.dtype), _saved(carry))
        begin = carry._replace(failed=jnp.full(carry.failed.shape, -1, jnp.int32))  # counts from this call's start
        end, saved = lax.fori_loop(0, saves, interval, (begin, buffer))
        first = jnp.where(end.failed < 0, -1, done + end.failed)
        return end._replace(failed=jnp.where(carry.failed < 0, first, carry.failed).astype(carry.failed.dtype)), saved

    return jax.jit(loop, compiler_options=compiler_options())


def _unsaved(carry: Carry) -> tuple[StepInfo, Range | None]:
    """The report and the range of no steps yet, of the shapes that they have in `carry`."""
    info = StepInfo(jnp.zeros_like(carry.info.residual), jnp.ones_like(carry.info.converged))
    return info, None if carry.change is None else Range.fresh(carry.change.total)


def _saved(carry: Carry) -> Any:
    return (carry.info, carry.state if carry.change is None else carry.change)


@cache
def energies(step_axis: int | None) -> Callable[..., Array]:
    """(step, states without their time, t0, done, dt) ↦ the energy less work of each member after `done` steps."""

    def energies_of(step: Step, states: State, t0: Array | None, done: ArrayLike, dt: Array) -> Array:
        return _over_members(energy, step_axis, step, on_clock(states, t0, done, dt))

    return jax.jit(energies_of, compiler_options=compiler_options())


def energy(step: Step, state: State) -> Array:
    """The energy of a step's system, less the work where the state counts it: H − W."""
    return energy_less_work(step.system, state)


def _over_members(function: Callable[..., Any], step_axis: int | None, step: Step, states: State) -> Any:
    """`function` of step and state, vmapped. What depends on a shared time alone is computed once for all members."""
    time_axis = None if states.t is None or not states.t.ndim else 0
    return jax.vmap(function, in_axes=(step_axis, State(0, 0, time_axis, 0, 0)))(step, states)  # pyright: ignore[reportArgumentType]


def _timed(states: State, t0: Array | None) -> State:
    return states if t0 is None else states._replace(t=t0)
