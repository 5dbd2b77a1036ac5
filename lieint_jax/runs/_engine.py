"""The engines of a run: machine code on a CPU, a kernel on a GPU, or XLA."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import native
from lieint_jax.native import UnsupportedError, computed_by, unsupported_if_it_fails, warn_once
from lieint_jax.runs import _layout, _loop
from lieint_jax.runs._clock import UniformClock
from lieint_jax.runs._comparison import difference, few_members
from lieint_jax.runs._job import Job, power_of_two
from lieint_jax.runs._layout import Layout, Numbers, Tree
from lieint_jax.runs._loop import Axes, Carry, Given, Intervals, Known, Reduction, Span
from lieint_jax.types import State

_log = logging.getLogger(__name__)
_MOST_SHARED = 200_000  # the most numbers shared by all members in a call: each thread holds them in memory


def engine_of(job: Job, mesh: Mesh, threads: int) -> Engine:
    """The engine of a run: machine code on a CPU, a kernel on a GPU, XLA's loop where neither is possible."""
    on_cpu = mesh.devices.flat[0].platform == "cpu"
    if native.engine_name() == "xla":
        _log.info("XLA runs %s: LIEINT_ENGINE or li.engine selects it", job.step.name)
        return Engine(job, "xla", threads)
    engine = Engine(job, "native" if on_cpu else "kernel", threads)
    reason = engine.refusal
    if not reason:
        what = f"machine code, in {threads} thread(s)," if on_cpu else "a kernel of the GPU"
        _log.info("%s runs %s: it computes every operation of the step", what, job.step.name)
        return engine
    if on_cpu:
        warn_once(job.step.name, reason)
    else:
        _log.info("XLA runs %s: %s", job.step.name, reason)
    return Engine(job, "xla", threads)


class Engine:
    """The compiled functions of a run.

    Args:
        job: the run.
        name: of the engine of its loops: "native" (machine code), "kernel" (of a GPU) or "xla".
        threads: the number of threads of machine code.

    Attributes:
        most_steps: the most steps in a call.
        refusal: why the engine cannot compute the run; empty if it can.
    """

    def __init__(self, job: Job, name: str, threads: int):
        self.job, self.name, self._threads = job, name, threads
        self.prepares = job.step.prepares and isinstance(job.clock, UniformClock)
        own, t0 = job.step_axis, 0 if job.t0 is not None and not job.shares_time else None
        reduced = None if job.reduction is None else 0
        self._plain: Axes = Given(own, None, t0, None, None)  # pyright: ignore[reportArgumentType]
        self._axes = 0, Given(0 if self.prepares else own, own, t0, None, reduced)  # pyright: ignore[reportArgumentType]
        self._intervals = self.intervals()
        self.refusal, self.most_steps = "", 2**30
        if name != "xla" and job.num_steps:
            known = self._intervals.known
            if name not in known:
                known[name] = self._examined()
            self.refusal, shared = known[name]
            if shared:
                self.most_steps = max(1, _MOST_SHARED // shared)

    def intervals(self) -> Intervals:
        """The loop over save intervals."""
        job = self.job
        step = job.step if job.step_axis is None else jax.tree.map(_member_shape, job.step)
        state = jax.tree.map(_member_shape, job.states)
        t0 = job.t0 if job.t0 is None or job.shares_time else _member_shape(job.t0)
        rests = None if job.rests is None else job.rests[:0]  # their number makes no difference
        return native.make_once(
            Intervals, (job.reduction, job.condition), self._axes, (step, state, t0, job.clock, rests)
        )

    def _examined(self) -> Known:
        """What this engine makes of the loop."""
        arguments = self._first_step()
        blocks = [slice(0, 1), slice(1, 2)] if self.job.members == 1 else [slice(None)]  # one member has its own code
        parts = [self._members(arguments, block) for block in blocks]
        with self._computing():
            code = native.machine_code(self._intervals.loop(*parts[0]))
        if isinstance(code, str):
            return Known(code)
        return Known(self._difference(arguments, parts) if self.name == "native" else "", code.shared)

    def _first_step(self) -> tuple[Tree, ...]:
        """The arguments of a first step of a few members."""
        job = few_members(self.job)
        given = Given(job.step, None, job.t0, job.clock, None)
        if self.prepares:
            given = given._replace(step=self._of_members(None)(given, job.states, 0), plain=job.step)
        value = None if job.reduction is None else np.zeros(job.members, job.dtype)
        ends = np.ones(2, _loop.step_dtype())
        rests = None if job.rests is None else np.full(ends.shape, job.first_dt / 2, job.dtype)
        spans = Span(0 * ends, ends, rests, np.ones(ends.shape, bool))
        carry = _loop.start(job.states, job.first_change(value, None))
        return carry, given._replace(quantity=value), spans, np.int32(1)

    def _members(self, arguments: tuple[Tree, ...], which: int | slice) -> tuple[Tree, ...]:
        """The arguments for some of these members."""
        carry, given, *others = arguments
        carry, given = (_part(axes, x, which) for axes, x in zip(self._axes, (carry, given), strict=True))
        return carry, given, *others

    def _difference(self, arguments: tuple[Tree, ...], parts: Sequence[tuple[Tree, ...]]) -> str:
        """In what a first step of a few members differs from XLA's; or ""."""

        def of_member(m: int) -> tuple[Tree, ...]:
            carry, given, spans, _ = self._members(arguments, m)
            return carry, given, jax.tree.map(lambda x: x[0], spans)

        try:
            with unsupported_if_it_fails():
                with self._computing():
                    ours = [self._intervals(*part) for part in parts]
                    by_xla = self._intervals.by_xla(*of_member(0))
                theirs = [by_xla(*of_member(m)) for m in range(sum(len(carry.failed) for carry, _ in ours))]
        except UnsupportedError as reason:
            return str(reason)
        ours = [(carry, jax.tree.map(lambda x: np.asarray(x)[0], saved)) for carry, saved in ours]
        return difference(
            jax.tree.map(lambda *x: np.concatenate(x), *ours), jax.tree.map(lambda *x: np.stack(x), *theirs)
        )

    def start(self, layout: Layout) -> tuple[Given, Carry]:
        """What is given for the members of a process, and their carry."""
        job = self.job
        step = (_layout.replicated if job.step_axis is None else _layout.placed)(layout, job.step)
        states = _layout.placed(layout, job.states)
        t0 = (_layout.replicated if job.shares_time else _layout.placed)(layout, job.t0)
        given = Given(step, None, t0, job.clock, None)
        if self.prepares:
            given = given._replace(step=self._of_members(None)(given, states, 0), plain=step)
        if job.reduction is None:
            return given, _loop.start(states, None)
        value = self.quantity(job.reduction, given, states, 0)
        reached = None if job.condition is None else self.quantity(job.condition, given, states, 0)
        return given._replace(quantity=value), _loop.start(states, job.first_change(value, reached))

    def quantity(self, function: Reduction, given: Given, states: State, n: int) -> Numbers:
        """A function of step and state at node n, for all members."""
        step = given.step if given.plain is None else given.plain
        return self._of_members(function)(given._replace(step=step, plain=None, quantity=None), states, n)

    def _of_members(self, function: Reduction | None) -> Callable[[Given, State, int], Tree]:
        """See `_loop.of_members`."""
        compiled = _loop.of_members(function, self._plain)

        def call(given: Given, states: State, n: int) -> Tree:
            with self._computing():
                return compiled(given, states, np.asarray(n, _loop.step_dtype()))

        return call

    def run_spans(self, given: Given, carry: Carry, spans: Span, rows: int) -> tuple[Carry, Tree]:
        """The carry after these save intervals, at most `rows`, and the saved rows."""
        count = np.int32(len(spans.first))
        if self.name != "xla":  # XLA's loops fill all rows
            rows = power_of_two(rows)
        spans = jax.tree.map(lambda x: np.resize(x, rows), spans)
        with self._computing():
            return jax.block_until_ready(self._intervals(carry, given, spans, count))

    def _computing(self) -> contextlib.AbstractContextManager[None]:
        return computed_by(self.name, self._threads)


def _part(axes: Axes, tree: Tree, which: int | slice) -> Tree:
    """The part of one member, or of some; `axes` as in `jax.vmap`."""
    return jax.tree.map(
        lambda axis, part: part if axis is None else jax.tree.map(lambda x: _layout.on_host(x)[which], part),
        axes,
        tree,
        is_leaf=lambda x: x is None,
    )


def _member_shape(x: Numbers) -> jax.ShapeDtypeStruct:
    """The shape of one member's part of an array."""
    return jax.ShapeDtypeStruct(np.shape(x)[1:], x.dtype)
