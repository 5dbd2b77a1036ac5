"""The engines of a run: machine code over blocks of members on a CPU, or XLA's loop over all members of a device."""

from __future__ import annotations

import abc
import functools
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax._integrate import UniformClock
from lieint_jax.ensemble import _layout, _loop
from lieint_jax.ensemble._comparison import compare, few_members
from lieint_jax.ensemble._job import Job
from lieint_jax.ensemble._layout import Layout, Numbers, Tree
from lieint_jax.ensemble._loop import (
    Axes,
    Carry,
    Interval,
    MappedInterval,
    Origin,
    Preparation,
    Quantity,
    Reduction,
    Saved,
    Span,
)
from lieint_jax.native import Flattened, Kernel, UnsupportedError, flatten, kernel
from lieint_jax.types import State, Step

_Program = TypeVar("_Program", Kernel, Flattened)

_log = logging.getLogger(__name__)
_SHORT = 2e6  # the most operations of a call that runs in one thread: more threads would not make it faster
_MOST_SHARED = 200_000  # the most numbers shared by all members in a call: each thread holds them in memory
_WIDEST = 160  # the most registers of 32 bits; a GPU's thread has 255, and the order of its instructions uses the rest
_MOST_CARRIED = 24  # the most numbers that an iteration of a loop reads and writes, and XLA may copy between kernels
_SHORT_STEP, _TOGETHER = 600, 4  # steps of at most so many operations are computed so many to an iteration


class Start(NamedTuple):
    """The initial data of the blocks of a layout; each field is a list with an item per block.

    Attributes:
        step, plain: the steps with the constants of whole steps, and without.
        origin: see `Origin`.
        carry: the carries.
    """

    step: list[Step]
    plain: list[Step]
    origin: list[Origin]
    carry: list[Carry]


def engine_of(job: Job, mesh: Mesh) -> Engine:
    """The engine of a run: machine code on a CPU, flat arrays elsewhere, XLA's plain loop where neither is possible."""
    on_cpu = mesh.devices.flat[0].platform == "cpu"
    try:
        return NativeEngine(job) if on_cpu else FlatEngine(job)
    except ImportError as error:
        _warn_once("ensembles", str(error))
    except UnsupportedError as reason:
        if on_cpu:
            _warn_once(job.step.name, str(reason))
        else:
            _log.debug("%s runs in XLA's plain loop: %s", job.step.name, reason)
    return XlaEngine(job)


@functools.cache
def _warn_once(what: str, reason: str) -> None:
    _log.warning("XLA runs %s, which is slower than machine code: %s", what, reason)


class Engine(abc.ABC):
    """The compiled functions of a run.

    Attributes:
        name: "native", "flat" or "xla".
        whole: True if a process has all of its members in one block.
        most_steps: the most steps in a call.
    """

    name: str
    whole: bool
    most_steps: int = 2**30

    def __init__(self, job: Job):
        self.job = job
        self.prepares = job.step.prepares and isinstance(job.clock, UniformClock)
        self._step_kind = "shared" if job.step_axis is None else "member"
        self._origin = Origin("shared" if job.shares_time else "member", "shared", "member")  # pyright: ignore

    def start(self, layout: Layout) -> Start:
        """The initial data of the blocks of a layout."""
        job = self.job
        step = (_layout.replicate if job.step_axis is None else _layout.scatter)(layout, job.step)
        states = _layout.scatter(layout, job.states)
        t0 = (_layout.replicate if job.shares_time else _layout.scatter)(layout, job.t0)
        start = Start(step, step, [Origin(t, job.clock, None) for t in t0], [])
        if self.prepares:
            start = start._replace(step=self.prepare(layout, start, states))
        origin = start.origin
        if job.reduction is not None:
            reduced = self.quantity(layout, job.reduction, start, states, 0)
            origin = [o._replace(quantity=x) for o, x in zip(origin, reduced, strict=True)]
        carry = [_loop.start(z, o.quantity) for z, o in zip(states, origin, strict=True)]
        return start._replace(origin=origin, carry=carry)

    @abc.abstractmethod
    def prepare(self, layout: Layout, start: Start, states: list[State]) -> list[Step]:
        """The steps with the constants of whole steps."""

    @abc.abstractmethod
    def quantity(self, layout: Layout, function: Reduction, start: Start, states: list[State], n: int) -> list[Numbers]:
        """A function of step and state at node n, for all members."""

    @abc.abstractmethod
    def run_spans(
        self, layout: Layout, start: Start, carry: list[Carry], spans: Span, rows: int
    ) -> tuple[list[Carry], list[Saved]]:
        """The carries after these save intervals, at most `rows`, and the saved rows."""

    def make_programs(self, make: Callable[..., _Program], together: int = 1) -> tuple[_Program | None, _Program]:
        """`Preparation`, if it is needed, and `Interval`, each compiled by `make(function, kinds, examples)`."""
        job = self.job
        step = job.step if job.step_axis is None else jax.tree.map(_member_shape, job.step)
        state = jax.tree.map(_member_shape, job.states)
        t0 = job.t0 if job.t0 is None or job.shares_time else _member_shape(job.t0)
        origin = Origin(t0, job.clock, None)  # pyright: ignore[reportArgumentType]
        preparation, prepared, kinds = None, step, self._step_kind
        if self.prepares:
            preparation = make(Preparation(), (self._step_kind, "member", self._origin), (step, state, origin))
            prepared, kinds = preparation.results, preparation.kinds_of_results
        value: Any = None if job.reduction is None else jax.ShapeDtypeStruct((), job.dtype)
        carry = jax.tree.map(_member_shape, _loop.start(jax.tree.map(lambda x: x[:1], job.states), value))
        plain = step if self.prepares else None
        count, rest = np.zeros((), _loop.step_dtype()), None if job.rests is None else np.zeros((), job.dtype)
        return preparation, make(
            Interval(job.reduction, together),
            ("carry", kinds, self._step_kind, self._origin, "row"),
            (carry, prepared, plain, origin._replace(quantity=value), Span(count, count, rest, np.bool_(True))),
        )

    def _axes_of_origin(self, quantity: int | None) -> Axes:
        """The member axes of an origin, as in `jax.vmap`; `quantity` is the axis of the reduced quantity."""
        own_time = self.job.t0 is not None and not self.job.shares_time
        return Origin(0 if own_time else None, None, None if self.job.reduction is None else quantity)  # pyright: ignore


class XlaEngine(Engine):
    """XLA, on the devices of a layout."""

    name, whole = "xla", False

    def prepare(self, layout: Layout, start: Start, states: list[State]) -> list[Step]:
        """See `Engine`."""
        compiled = _loop.compile_for_members(Preparation(), (self.job.step_axis, 0, self._axes_of_origin(None)))
        return _layout.map_blocks(layout, compiled, start.plain, states, start.origin)

    def quantity(self, layout: Layout, function: Reduction, start: Start, states: list[State], n: int) -> list[Numbers]:
        """See `Engine`."""
        compiled = _loop.compile_for_members(
            Quantity(function), (self.job.step_axis, 0, self._axes_of_origin(None), None)
        )
        origin = [o._replace(quantity=None) for o in start.origin]
        return _layout.map_blocks(layout, lambda *x: compiled(*x, n), start.plain, states, origin)

    def run_spans(
        self, layout: Layout, start: Start, carry: list[Carry], spans: Span, rows: int
    ) -> tuple[list[Carry], list[Saved]]:
        """See `Engine`."""
        count = len(spans.first)
        spans = jax.tree.map(lambda x: np.resize(x, rows), spans)
        compiled = _loop.compile_intervals(self.interval())
        plain = start.plain if self.prepares else [None] * len(carry)
        results = _layout.map_blocks(
            layout, lambda *x: compiled(*x, spans, count), carry, start.step, plain, start.origin
        )
        return [c for c, _ in results], [rows for _, rows in results]

    def interval(self) -> MappedInterval:
        """`Interval` for all members."""
        own = self.job.step_axis
        return _loop.vmap_interval(
            self.job.reduction, (0, 0 if self.prepares else own, own, self._axes_of_origin(0), None)
        )


class FlatEngine(XlaEngine):
    """XLA, on the devices of a layout, with an array (members,) for each number of a step.

    XLA compiles the operations between two loops of the step into one kernel, if their numbers fit a GPU's registers.

    Raises:
        UnsupportedError: the step is not a program of numbers, or has too many live numbers.
    """

    name = "flat"

    def __init__(self, job: Job):
        super().__init__(job)
        self._preparation, self._flat = self.make_programs(flatten)
        if self._flat.width > _WIDEST:
            raise UnsupportedError(f"about {self._flat.width} registers, more than {_WIDEST}")
        if self._flat.carried > _MOST_CARRIED:
            raise UnsupportedError(f"a loop with {self._flat.carried} numbers, more than {_MOST_CARRIED}")
        if self._flat.length <= _SHORT_STEP:
            _, self._flat = self.make_programs(flatten, _TOGETHER)

    def prepare(self, layout: Layout, start: Start, states: list[State]) -> list[Step]:
        """See `Engine`."""
        steps, preparation = super().prepare(layout, start, states), self._preparation
        return (
            steps
            if preparation is None
            else [_without_shared_axis(preparation.kinds_of_results, step) for step in steps]
        )

    def interval(self) -> MappedInterval:
        """`Interval` for all members."""
        return self._flat


class NativeEngine(Engine):
    """Machine code, in threads of this process; all members of a process are one block."""

    name, whole = "native", True

    def __init__(self, job: Job):
        super().__init__(job)
        preparation, self._interval = self.make_programs(kernel)
        if job.num_steps and not self._interval.is_compared:
            self._compare_first_step(preparation)
        if self._interval.refusal:
            raise UnsupportedError(self._interval.refusal)
        if self._interval.shared:
            self.most_steps = max(1, _MOST_SHARED // self._interval.shared)

    def _compare_first_step(self, preparation: Kernel | None) -> None:
        """Compare a first step with XLA's."""
        job = few_members(self.job)
        members, step, plain = job.states.p.shape[0], job.step, None
        origin = Origin(job.t0, job.clock, None)
        if preparation is not None:
            plain, step = step, preparation((step, job.states, origin), members)
            step = _without_shared_axis(preparation.kinds_of_results, jax.tree.map(lambda x: x[0], step))
        value = None if job.reduction is None else np.zeros(members, job.dtype)
        ends = np.ones(1, _loop.step_dtype())
        rests = None if job.rests is None else np.full(1, job.first_dt / 2, job.dtype)
        spans = Span(0 * ends, ends, rests, np.ones(1, bool))
        arguments = _loop.start(job.states, value), step, plain, origin._replace(quantity=value), spans
        compare(self._interval, arguments, members)

    def prepare(self, layout: Layout, start: Start, states: list[State]) -> list[Step]:
        """See `Engine`."""
        arguments = start.plain[0], states[0], start.origin[0]
        compiled, results = self._map_members(
            layout, Preparation(), (self._step_kind, "member", self._origin), arguments
        )
        return [_without_shared_axis(compiled.kinds_of_results, results)]

    def quantity(self, layout: Layout, function: Reduction, start: Start, states: list[State], n: int) -> list[Numbers]:
        """See `Engine`. XLA computes a quantity that is not a program of numbers, even if the step is one."""
        origin, node = start.origin[0]._replace(quantity=None), np.asarray(n, _loop.step_dtype())
        arguments = start.plain[0], states[0], origin, node
        try:
            return [
                self._map_members(
                    layout, Quantity(function), (self._step_kind, "member", self._origin, "shared"), arguments
                )[1]
            ]
        except UnsupportedError:
            axes = self.job.step_axis, 0, self._axes_of_origin(None), None
            return [np.asarray(_loop.compile_for_members(Quantity(function), axes)(*arguments))]

    def _map_members(
        self, layout: Layout, function: Callable[..., Tree], kinds: Sequence[Tree], arguments: Sequence[Tree]
    ) -> tuple[Kernel, Tree]:
        """A function of one member, compiled, and its results for all members."""
        examples = tuple(
            jax.tree.map(
                lambda k, part: jax.tree.map(_member_shape if k == "member" else lambda x: x, part), kind, argument
            )
            for kind, argument in zip(kinds, arguments, strict=True)
        )
        compiled = kernel(function, kinds, examples)
        results = compiled(arguments, arguments[1].p.shape[0], 1, layout.threads)
        return compiled, jax.tree.map(lambda x: x[0], results)

    def run_spans(
        self, layout: Layout, start: Start, carry: list[Carry], spans: Span, rows: int
    ) -> tuple[list[Carry], list[Saved]]:
        """See `Engine`."""
        plain = start.plain[0] if self.prepares else None
        arguments = carry[0], start.step[0], plain, start.origin[0], spans
        members = len(carry[0].failed)
        steps = int(spans.end[-1] - spans.first[0])
        work = members * steps * self._interval.length
        threads = layout.threads if work > _SHORT else 1
        after, saved = self._interval(arguments, members, len(spans.first), threads)
        return [after], [saved]


def _without_shared_axis(kinds: Tree, results: Tree) -> Tree:
    """Results of all members, with the first in place of all where the members share one."""
    return jax.tree.map(lambda kind, x: x[0] if kind == "shared" else x, kinds, results)


def _member_shape(x: Numbers) -> jax.ShapeDtypeStruct:
    """The shape of one member's part of an array."""
    return jax.ShapeDtypeStruct(np.shape(x)[1:], x.dtype)
