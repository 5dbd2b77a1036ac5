"""The engines of a run: machine code on a CPU, a kernel on a GPU, or XLA.

Machine code is this package's own reading of a jaxpr. A misread primitive would be a wrong number without a sign of it,
so before it computes a run, each compiled function is compared once with XLA's program, for a first step of a few of
its members.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import native
from lieint_jax._xla import reads
from lieint_jax.native import UnsupportedError, computed_by, unsupported_if_it_fails, warn_once
from lieint_jax.runs._job import devices, loop
from lieint_jax.runs._job.devices import Numbers, Tree
from lieint_jax.runs._job.digests import OfMember, digest_or_reason
from lieint_jax.runs._job.job import Job
from lieint_jax.runs._job.loop import Axes, Carry, Given, MemberLoop, Reduction, Span
from lieint_jax.runs._march.clock import Clock, GridClock, power_of_two
from lieint_jax.runs._march.driver import prepared
from lieint_jax.types import State, Step

_log = logging.getLogger(__name__)
_FEW = 3  # members that are compared
_CHANGE = 8  # round-offs by which a copy of each of them differs
_LEEWAY = 1000  # times that the results of a copy may differ: machine code rounds in another order
_ROUNDING = ("residual",)  # results that are nothing but rounding errors
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
    """

    def __init__(self, job: Job, name: str, threads: int):
        self.job, self.name, self._threads = job, name, threads
        self.prepares = job.step.prepares and not isinstance(job.clock, GridClock)
        own, of_time = job.step_axis, 0 if job.own_times else None
        reduced = None if job.reduction is None else 0
        self._plain: Axes = Given(own, None, of_time, None, None)  # pyright: ignore[reportArgumentType]
        self._axes = 0, Given(0 if self.prepares else own, own, of_time, None, reduced)  # pyright: ignore[reportArgumentType]
        self._loop = self._made(job.reduction, job.condition)

    @cached_property
    def _known(self) -> tuple[str, int]:
        """What `Learned.engines` has of this engine; nothing refuses a run by XLA or of no steps."""
        if self.name == "xla" or not self.job.num_steps:
            return "", 0
        known = self._loop.learned.engines
        if self.name not in known:
            known[self.name] = self._examined()
        return known[self.name]

    @property
    def refusal(self) -> str:
        """Why the engine cannot compute the run; empty if it can."""
        return self._known[0]

    @property
    def most_steps(self) -> int:
        """The most steps in a call."""
        shared = self._known[1]
        return max(1, _MOST_SHARED // shared) if shared else 2**30

    def _made(self, *what: Reduction | None) -> MemberLoop:
        """The loop of a run that reduces this quantity until this condition, made once."""
        job, axes = self.job, self._axes
        if what[0] is None:
            axes = axes[0], axes[1]._replace(quantity=None)
        rests = None if job.rests is None else job.rests[:0]  # their number makes no difference
        examples = *self._of_one_member(), job.clock, rests
        return native.make_once(MemberLoop, what, axes, examples, reads(*what, jax.tree.structure(examples)))

    def _of_one_member(self) -> tuple[Step, State, Numbers | None]:
        """The step of a member, its initial state and its time; what each member has of its own is a shape."""
        job = self.job
        step = job.step if job.step_axis is None else jax.tree.map(_member_shape, job.step)
        t0: Any = _member_shape(job.t0) if job.own_times else job.t0  # pyright: ignore
        return step, jax.tree.map(_member_shape, job.states), t0

    @property
    def equations(self) -> dict[str, str | None]:
        """The digests of the equations of the step, of `reduce` and of `first`, or why these cannot be compared.

        Those of the step are of the loop that the run compiles, which JAX has traced; only a run with `reduce` traces
        its step once more.
        """
        job, made = self.job, self._made(None, None)
        plain, state, t0 = self._of_one_member()
        at_start: Any = state if t0 is None else state._replace(t=jax.ShapeDtypeStruct((), job.dtype))
        examples = plain, at_start, job.clock
        of_time = 0 if job.own_times else None
        axes = job.step_axis, jax.tree.map(lambda _: 0, at_start)._replace(t=of_time), None
        with computed_by(self.name, self._threads):
            if made.learned.equations is None:
                given, programs = Given(plain, None, t0, job.clock, None), []
                if self.prepares:
                    step, program = _with_constants(examples, axes)
                    given, programs = given._replace(step=step, plain=plain), [program]
                interval = made.traced(*loop.shapes_of_interval(state, job.rests is not None), given)
                made.learned.equations = digest_or_reason(*programs, interval)
            found: dict[str, str | None] = {"equations of the step": made.learned.equations}
            for name, f in {"equations of reduce": job.reduction, "equations of first": job.condition}.items():
                read = reads(f, jax.tree.structure(examples))
                found[name] = f and native.make_once(_equations_of, f, (self.prepares, axes), examples, read)
            return found

    def _examined(self) -> tuple[str, int]:
        """What `Learned.engines` has of this engine."""
        arguments = self._first_step()
        blocks = [slice(0, 1), slice(1, 2)] if self.job.members == 1 else [slice(None)]  # one member has its own code
        parts = [self._members(arguments, block) for block in blocks]
        with computed_by(self.name, self._threads):
            [loop] = native.loops_of(self._loop.of_all.trace(*parts[0]).jaxpr)
            assert loop is not None
            code = native.machine_code(loop)
        if isinstance(code, str):
            return code, 0
        return self._difference(arguments, parts) if self.name == "native" else "", code.shared

    def _first_step(self) -> tuple[Tree, ...]:
        """The arguments of a first step of a few members."""
        job = _few_members(self.job)
        given = self._given(job.step, job.t0, job.states)
        value = None if job.reduction is None else np.zeros(job.members, job.dtype)
        ends = np.ones(2, loop.step_dtype())
        rests = None if job.rests is None else np.full(ends.shape, job.first_dt / 2, job.dtype)
        spans = Span(0 * ends, ends, rests, np.ones(ends.shape, bool))
        carry = loop.start(job.states, job.first_change(value, None))
        return carry, given._replace(quantity=value), spans, np.int32(1)

    def _members(self, arguments: tuple[Tree, ...], which: int | slice) -> tuple[Tree, ...]:
        """The arguments for some of these members."""

        def part(axis: int | None, tree: Tree) -> Tree:
            return tree if axis is None else jax.tree.map(lambda x: devices.on_host(x)[which], tree)

        chosen = jax.tree.map(part, self._axes, arguments[:2], is_leaf=lambda x: x is None)
        return *chosen, *arguments[2:]

    def _difference(self, arguments: tuple[Tree, ...], parts: Sequence[tuple[Tree, ...]]) -> str:
        """The first result in which a first step of a few members differs from XLA's; or "".

        It differs if a change of the states by rounding does not explain it: see `_few_members`.
        """

        def of_member(m: int) -> tuple[Tree, ...]:
            carry, given, spans, _ = self._members(arguments, m)
            return carry, given, jax.tree.map(lambda x: x[0], spans)

        try:
            with unsupported_if_it_fails(), computed_by(self.name, self._threads):
                ours = [self._loop.of_all(*part) for part in parts]
                members = range(sum(len(carry.failed) for carry, _ in ours))
                theirs = self._loop.by_xla(map(of_member, members))
        except UnsupportedError as reason:
            return str(reason)
        ours = [(carry, jax.tree.map(lambda x: np.asarray(x)[0], saved)) for carry, saved in ours]
        ours, theirs = jax.tree.map(lambda *x: np.concatenate(x), *ours), jax.tree.map(lambda *x: np.stack(x), *theirs)
        n = len(jax.tree.leaves(ours)[0]) // 2
        for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
            name, x = jax.tree_util.keystr(path), np.asarray(x)
            if not name.endswith(_ROUNDING) and not _agree(x[:n], y[:n], y[n:]):
                return f"in machine code a first step differs in {name}"
        return ""

    def start(self, mesh: Mesh) -> tuple[Given, Carry]:
        """What is given for the members, and their carry, on the devices of a mesh."""
        job = self.job
        step = devices.placed(mesh, job.step, own=job.step_axis is not None)
        states = devices.placed(mesh, job.states)
        t0 = devices.placed(mesh, job.t0, own=job.own_times)
        given = self._given(step, t0, states)
        if job.reduction is None:
            return given, loop.start(states, None)
        value = self.quantity(job.reduction, given, states, 0)
        reached = None if job.condition is None else self.quantity(job.condition, given, states, 0)
        return given._replace(quantity=value), loop.start(states, job.first_change(value, reached))

    def _given(self, step: Step, t0: Numbers | None, states: State) -> Given:
        """What is given for members of these steps and initial states."""
        given = Given(step, None, t0, self.job.clock, None)
        return given._replace(step=self.quantity(None, given, states, 0), plain=step) if self.prepares else given

    def quantity(self, function: Reduction | None, given: Given, states: State, n: int) -> Tree:
        """A function of step and state at node n, for all members; without one the step with its constants."""
        plain = given._replace(step=given.step if given.plain is None else given.plain, plain=None, quantity=None)
        with computed_by(self.name, self._threads):
            return loop.of_members(function, self._plain)(plain, states, np.asarray(n, loop.step_dtype()))

    def run_intervals(
        self, given: Given, carry: Carry, done: int, saved: int, ends: np.ndarray, rows: int
    ) -> tuple[Carry, Tree]:
        """The carry after the save intervals that end at the nodes `ends`, at most `rows`, and the saved rows.

        Before them there were `done` steps, and `saved` entries after the start.
        """
        dtype, rests, count = loop.step_dtype(), self.job.rests, len(ends)
        first = np.concatenate([[done], ends[:-1]]).astype(dtype)
        begins = (np.arange(count) > 0) | (done == self.job.nodes[saved])
        if rests is not None:
            rests = np.resize(rests[saved + 1 :], count).astype(self.job.dtype)
        rows = rows if self.name == "xla" else power_of_two(rows)  # XLA's loops fill all rows
        spans = jax.tree.map(lambda x: np.resize(x, rows), Span(first, ends.astype(dtype), rests, begins))
        with computed_by(self.name, self._threads):
            return jax.block_until_ready(self._loop.of_all(carry, given, spans, np.int32(count)))


def _equations_of(function: Reduction, kinds: tuple[bool, Axes], examples: tuple[Step, State, Clock]) -> str:
    """The digest of a function's equations for a step, if `kinds` says so also with its constants, and a state.

    The other of `kinds` are the member axes of the examples.
    """
    (prepares, axes), (step, state, _) = kinds, examples
    steps = [(axes[0], step)]
    if prepares:
        steps.append((0, _with_constants(examples, axes)[0]))
    return digest_or_reason(*(_of_member(function, (own, axes[1]), (each, state))[0] for own, each in steps))


def _with_constants(examples: tuple[Step, State, Clock], axes: Axes) -> tuple[Step, OfMember]:
    """The shapes of a step with its constants, and the program that computes these."""
    program, shapes = _of_member(prepared, axes, examples)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), shapes), program


def _of_member(function: Callable[..., Tree], axes: Axes, arguments: tuple[Tree, ...]) -> tuple[OfMember, Tree]:
    """The program of a function of one member, and the shapes of its results."""
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return OfMember(program, [axis is not None for axis in loop.axes_of_leaves(axes, arguments)]), shapes


def _member_shape(x: Numbers) -> jax.ShapeDtypeStruct:
    """The shape of one member's part of an array."""
    return jax.ShapeDtypeStruct(np.shape(x)[1:], x.dtype)


def _few_members(job: Job) -> Job:
    """The job of a few members and of a copy of each of them that differs by rounding."""
    chosen = np.unique(np.linspace(0, job.members - 1, _FEW).astype(int))
    few, n = job.select(np.tile(chosen, 2)), len(chosen)

    def changed(x: np.ndarray) -> np.ndarray:
        if x.dtype.kind == "f":
            largest = np.abs(x[n:]).max(axis=tuple(range(1, x.ndim)), keepdims=True, initial=0)
            pattern = np.cos(1.0 + np.arange(x[n:].size)).reshape(x[n:].shape)
            x[n:] += (_CHANGE * np.finfo(x.dtype).eps * largest * pattern).astype(x.dtype)
        return x

    return few._replace(states=jax.tree.map(changed, few.states), make_states=None, part=None)


def _agree(ours: np.ndarray, theirs: np.ndarray, changed: np.ndarray) -> bool:
    """Whether results (members, …) agree, given XLA's for the states of `theirs` changed by rounding."""
    if theirs.dtype.kind != "f":
        return bool(np.all((ours == theirs) | (theirs != changed)))
    axes = tuple(range(1, theirs.ndim))
    with np.errstate(invalid="ignore"):
        differs, spread = np.abs(ours - theirs), np.abs(changed - theirs)
        undecided = ~np.isfinite(spread) & (theirs != changed) & ~(np.isnan(theirs) & np.isnan(changed))
        same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs)) | undecided
    size, rounding = (np.max(np.where(np.isfinite(x), x, 0), axis=axes, initial=0) for x in (np.abs(theirs), spread))
    allowed = np.sqrt(np.finfo(theirs.dtype).eps) * size + _LEEWAY * rounding
    return bool(np.all(same | (allowed >= differs.T).T))
