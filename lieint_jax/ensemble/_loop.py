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

from lieint_jax._numerics import kernel
from lieint_jax.ensemble._layout import part_of
from lieint_jax.integrate import Given, Uniform, prepared
from lieint_jax.types import State, Step, StepInfo, energy_less_work, pytree, static

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
        clock: when the steps are; if they are of one size, its own t0 says nothing.
        quantity: the reduced quantity of the initial states; None if nothing is reduced.
    """

    t0: Array | None
    clock: Uniform | Given
    quantity: Array | None

    def at(self, n: ArrayLike, states: State) -> State:
        """The states with their time, that of node n, if they have one."""
        if self.t0 is None:
            return states
        clock = self.clock._replace(t0=self.t0) if isinstance(self.clock, Uniform) else self.clock
        return states._replace(t=clock.time(n))


class Portion(NamedTuple):
    """The part of a run that one call of the compiled loop does.

    Attributes:
        done: the number of steps taken before.
        saves: the number of save intervals.
        ends: the number of steps from the start of this call to the end of each interval, (rows,).
        rests: the size of the shorter step to each output, (rows,); None if outputs are at the ends.
        fresh: True if a save interval begins here; False if the call continues one, whose report is in the carry.
    """

    done: Any
    saves: Any
    ends: Any
    rests: Any
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
    """(step, states without their time, t0, clock) ↦ the carry of a run and its origin."""

    def begin(step: Step, states: State, t0: Array | None, clock: Uniform | Given) -> tuple[Carry, Origin]:
        members = states.p.shape[0]
        info = StepInfo(jnp.zeros(members, states.p.dtype), jnp.ones(members, bool))
        quantity = None if reduction is None else _over_members(reduction, step_axis, step, _timed(states, t0))
        change = None if quantity is None else Range.fresh(quantity)
        failed = jnp.full(members, -1, step_dtype())
        return Carry(states, info, failed, change), Origin(t0, clock, quantity)

    return jax.jit(begin, compiler_options=compiler_options())


@cache
def prepare(step_axis: int | None) -> Callable[..., Any]:
    """(step, states without their time, origin) ↦ the steps for whole steps, with the member axis on every leaf."""

    def prepared_steps(step: Step, states: State, origin: Origin) -> Step:
        return _over_members(lambda s, z: prepared(s, z, origin.clock), step_axis, step, origin.at(0, states))

    return jax.jit(prepared_steps, compiler_options=compiler_options())


@cache
def advance(
    axes: tuple[int | None, int | None], reduction: Reduction | None, most: int | None
) -> Callable[..., tuple[Carry, Any]]:
    """The compiled loop (steps, carry, origin, portion) ↦ (carry, saved).

    `steps` are the step of whole steps and that of the shorter ones to outputs between nodes, and `axes` their member
    axes. Each row of `saved` holds the report, and the state or the change of the reduced quantity since `origin`. With
    `most`, one kernel does it all for a part of the members, at most so many, and then for the next.
    """

    def loop(steps: tuple[Step, Step], carry: Carry, origin: Origin, portion: Portion) -> tuple[Carry, Any]:
        done, saves, ends, rests, fresh = portion
        unsaved = _unsaved(carry)

        def stepped(which: int, n: Array, seen: _Seen, dt: Array) -> _Seen:
            def one_step(step: Step, state: State) -> tuple[State, StepInfo]:
                state, info = step(state, dt)
                return state if origin.t0 is None else state._replace(t=None), info

            states = origin.at(done + n, _joined(seen.state))
            return seen.after(n, *_over_members(one_step, axes[which], steps[which], states))

        def one(n: Array, seen: _Seen) -> _Seen:
            seen = stepped(0, n, seen, origin.clock.size(done + n))
            if reduction is None or seen.change is None or origin.quantity is None:
                return seen
            after = _over_members(reduction, axes[0], steps[0], origin.at(done + n + 1, _joined(seen.state)))
            return seen._replace(change=seen.change.including(after - origin.quantity))

        def interval(k: Array, loop: tuple[Carry, Any]) -> tuple[Carry, Any]:
            carry, saved = loop
            begins = (k > 0) | fresh
            info, change = jax.tree.map(
                lambda new, old: jnp.where(begins, new, old), unsaved, (carry.info, carry.change)
            )
            carry, begun = carry._replace(info=info, change=change), jnp.where(k > 0, ends[k - 1], 0)
            seen = lax.fori_loop(0, ends[k] - begun, lambda i, s: one(begun + i, s), _Seen.of(carry))
            carry = shown = seen.told(carry)
            if rests is not None:
                rest = stepped(1, ends[k], _Seen.of(carry), rests[k])
                shown = rest.told(carry)
                carry = carry._replace(failed=shown.failed)
            return carry, jax.tree.map(lambda to, x: to.at[k].set(x), saved, _saved(shown))

        buffer = jax.tree.map(lambda x: jnp.zeros((len(ends), *x.shape), x.dtype), _saved(carry))
        begin = carry._replace(failed=jnp.full(carry.failed.shape, -1, jnp.int32))  # counts from this call's start
        end, saved = lax.fori_loop(0, saves, interval, (begin, buffer))
        first = jnp.where(end.failed < 0, -1, done + end.failed)
        return end._replace(failed=jnp.where(carry.failed < 0, first, carry.failed).astype(carry.failed.dtype)), saved

    return jax.jit(loop if most is None else _in_parts(loop, axes, most), compiler_options=compiler_options())


def _in_parts(
    loop: Callable[..., tuple[Carry, Any]], axes: tuple[int | None, int | None], most: int
) -> Callable[..., Any]:
    """The loop over parts of the members, one after the other, each in one kernel, its member axis the last."""
    in_one_kernel = kernel.one_kernel(loop)

    def parts(steps: tuple[Step, Step], carry: Carry, origin: Origin, portion: Portion) -> tuple[Carry, Any]:
        members = carry.failed.shape[0]

        def cut(x: Array) -> Array:
            return jnp.moveaxis(x.reshape(-1, part_of(members, most), *x.shape[1:]), 1, -1)

        def part(own: Any) -> tuple[Carry, Any]:
            mine, carry, t0, quantity = own
            both = tuple(step if its is None else its for its, step in zip(mine, steps, strict=True))
            begun = origin._replace(t0=origin.t0 if t0 is None else t0, quantity=quantity)
            return in_one_kernel(both, carry, begun, portion)

        def whole(x: Array) -> Array:
            x = jnp.moveaxis(x, -1, 1)
            return x.reshape(members, *x.shape[2:])

        mine = tuple(step if axis == 0 else None for step, axis in zip(steps, axes, strict=True))
        t0 = origin.t0 if origin.t0 is not None and origin.t0.ndim else None
        end, saved = lax.map(part, jax.tree.map(cut, (mine, carry, t0, origin.quantity)))
        rows = jax.tree.map(lambda x: jax.vmap(whole, 1)(x), saved)
        return jax.tree.map(whole, end), rows

    return parts


class _Seen(NamedTuple):
    """What the innermost loop carries, in numbers of one width, which is what vectorises.

    Attributes:
        state: the states; in one kernel each component by itself.
        residual: the largest since the last save.
        first: the first step since the last save that did not converge, or the largest integer.
        change: as of a `Carry`.
    """

    state: State
    residual: Array
    first: Array
    change: Range | None

    @classmethod
    def of(cls, carry: Carry) -> _Seen:
        """What a loop begins with that continues from `carry`."""
        like = carry.info.residual
        kind = jnp.int64 if like.dtype == jnp.float64 else jnp.int32
        return cls(_split(carry.state), like, jnp.full(like.shape, jnp.iinfo(kind).max, kind), carry.change)

    def after(self, n: Array, state: State, info: StepInfo) -> _Seen:
        """After step n, which led to `state`."""
        state, info = kernel.stored((_split(state), info))
        kind = self.first.dtype
        failed = jnp.where(info.converged, jnp.iinfo(kind).max, n.astype(kind))
        residual, first = jnp.maximum(self.residual, info.residual), jnp.minimum(self.first, failed)
        return _Seen(state, residual, first, self.change)

    def told(self, carry: Carry) -> Carry:
        """`carry`, with what was seen since."""
        good = self.first == jnp.iinfo(self.first.dtype).max
        failed = jnp.where((carry.failed < 0) & ~good, self.first.astype(carry.failed.dtype), carry.failed)
        return Carry(_joined(self.state), StepInfo(self.residual, carry.info.converged & good), failed, self.change)


@pytree
class _Split:
    """The components of an array (…, members), each (members,)."""

    components: tuple[Array, ...]
    shape: tuple[int, ...] = static()


def _split(tree: Any) -> Any:
    if not kernel.inside():
        return tree

    def one(x: Array) -> _Split:
        flat = x.reshape(-1, x.shape[-1])
        return _Split(tuple(flat[k] for k in range(len(flat))), x.shape)

    return jax.tree.map(one, tree)


def _joined(tree: Any) -> Any:
    def one(x: Any) -> Array:
        return jnp.stack(x.components).reshape(x.shape) if isinstance(x, _Split) else x

    return jax.tree.map(one, tree, is_leaf=lambda x: isinstance(x, _Split))


def _unsaved(carry: Carry) -> tuple[StepInfo, Range | None]:
    """The report and the range of no steps yet, of the shapes that they have in `carry`."""
    info = StepInfo(jnp.zeros_like(carry.info.residual), jnp.ones_like(carry.info.converged))
    return info, None if carry.change is None else Range.fresh(carry.change.total)


def _saved(carry: Carry) -> Any:
    return (carry.info, carry.state if carry.change is None else carry.change)


@cache
def energies(step_axis: int | None) -> Callable[..., Array]:
    """(step, states without their time, origin, done) ↦ the energy less work of each member after `done` steps."""

    def energies_of(step: Step, states: State, origin: Origin, done: ArrayLike) -> Array:
        return _over_members(energy, step_axis, step, origin.at(done, states))

    return jax.jit(energies_of, compiler_options=compiler_options())


def energy(step: Step, state: State) -> Array:
    """The energy of a step's system, less the work where the state counts it: H − W."""
    return energy_less_work(step.system, state)


def _over_members(function: Callable[..., Any], step_axis: int | None, step: Step, states: State) -> Any:
    """`function` of step and state, vmapped. What depends on a shared time alone is computed once for all members."""
    axis = -1 if kernel.inside() else 0
    time_axis = None if states.t is None or not states.t.ndim else 0
    in_axes: Any = (None if step_axis is None else axis, State(axis, axis, time_axis, axis, axis))  # pyright: ignore[reportArgumentType]
    return jax.vmap(function, in_axes, axis)(step, states)


def _timed(states: State, t0: Array | None) -> State:
    return states if t0 is None else states._replace(t=t0)
