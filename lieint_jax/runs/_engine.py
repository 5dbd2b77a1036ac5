"""The engines of a run: machine code on a CPU, a kernel on a GPU, or XLA.

Machine code is this package's own reading of a jaxpr. A misread primitive would be a wrong number without a sign of it,
so before it computes a run, each compiled function is compared once with XLA's program, for a first step of a few of
its members.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import jax
import numpy as np

from lieint_jax import native
from lieint_jax._xla import reads
from lieint_jax.core import State, Step
from lieint_jax.native import UnsupportedError, computed_by, unsupported_if_it_fails, warn_once
from lieint_jax.runs import _devices as devices
from lieint_jax.runs import _loop as loop
from lieint_jax.runs._clock import Clock, GridClock, UniformClock, power_of_two
from lieint_jax.runs._devices import Numbers, Tree
from lieint_jax.runs._digests import OfMember, digest_or_reason
from lieint_jax.runs._driver import prepared
from lieint_jax.runs._loop import Axes, Carry, Given, MemberLoop, Reduction, Span
from lieint_jax.runs._plan import Plan

_log = logging.getLogger(__name__)
_FEW = 3  # members that are compared
_CHANGE = 8  # round-offs by which a copy of each of them differs
_LEEWAY = 1000  # times that the results of a copy may differ: machine code rounds in another order
_ROUNDING = ("residual",)  # results that are nothing but rounding errors
_MOST_SHARED = 200_000  # the most numbers shared by all members in a call: each thread holds them in memory


def engine_of(plan: Plan) -> Engine:
    """The engine of a run: machine code on a CPU, a kernel on a GPU, XLA's loop where neither is possible."""
    on_cpu, name = devices.on_cpu(plan.mesh), plan.step.name
    if native.engine_name() == "xla":
        _log.info("XLA runs %s: LIEINT_ENGINE or li.engine selects it", name)
        return Engine(plan, "xla")
    engine = Engine(plan, "native" if on_cpu else "kernel")
    reason = engine.refusal
    if not reason:
        what = f"machine code, in {plan.threads} thread(s)," if on_cpu else "a kernel of the GPU"
        _log.info("%s runs %s: it computes every operation of the step", what, name)
        return engine
    if on_cpu:
        warn_once(name, reason)
    else:
        _log.info("XLA runs %s: %s", name, reason)
    return Engine(plan, "xla")


class Engine:
    """The compiled functions of a run.

    Args:
        plan: the run.
        name: of the engine of its loops: "native" (machine code), "kernel" (of a GPU) or "xla".
    """

    def __init__(self, plan: Plan, name: str):
        self.plan, self.name = plan, name
        self.prepares = plan.step.prepares and not isinstance(plan.clock, GridClock)
        own, reduced = 0 if plan.own_step else None, None if plan.reduction is None else 0
        clock: Axes = UniformClock(0, None, None) if plan.own_times else None  # pyright: ignore[reportArgumentType]
        self._plain: Axes = Given(own, None, clock, None)  # pyright: ignore[reportArgumentType]
        self._axes = 0, Given(0 if self.prepares else own, own, clock, reduced)  # pyright: ignore[reportArgumentType]
        self._loop = self._made(plan.reduction, plan.condition)

    @cached_property
    def _known(self) -> tuple[str, int]:
        """What `Learned.engines` has of this engine; nothing refuses a run by XLA or of no steps."""
        if self.name == "xla" or not self.plan.num_steps:
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
        plan, axes = self.plan, self._axes
        if what[0] is None:
            axes = axes[0], axes[1]._replace(quantity=None)
        rests = None if plan.rests is None else plan.rests[:0]  # their number makes no difference
        examples = *self._of_one_member(), rests
        return native.make_once(MemberLoop, what, axes, examples, reads(*what, jax.tree.structure(examples)))

    def _of_one_member(self) -> tuple[Step, State, Clock]:
        """The step of a member, its initial state and its clock; what each member has of its own is a shape."""
        plan, clock = self.plan, self.plan.members_clock
        step = jax.tree.map(_member_shape, plan.step) if plan.own_step else plan.step
        if plan.own_times:
            clock = clock._replace(t0=_member_shape(clock.t0))  # pyright: ignore
        return step, jax.tree.map(_member_shape, plan.states), clock

    @property
    def equations(self) -> dict[str, str | None]:
        """The digests of the equations of the step, of `reduce` and of `first`, or why these cannot be compared.

        Those of the step are of the loop that the run compiles, which JAX has traced; only a run with `reduce` traces
        its step once more.
        """
        plan, made = self.plan, self._made(None, None)
        plain, state, clock = examples = self._of_one_member()
        axes: Axes = 0 if plan.own_step else None, jax.tree.map(lambda _: 0, state), self._plain.clock
        with computed_by(self.name, self.plan.threads):
            if made.learned.equations is None:
                given, programs = Given(plain, None, clock, None), []
                if self.prepares:
                    step, program = _with_constants(examples, axes)
                    given, programs = given._replace(step=step, plain=plain), [program]
                interval = made.traced(*loop.shapes_of_interval(state, plan.rests is not None), given)
                made.learned.equations = digest_or_reason(*programs, interval)
            found: dict[str, str | None] = {"equations of the step": made.learned.equations}
            for name, f in {"equations of reduce": plan.reduction, "equations of first": plan.condition}.items():
                read = reads(f, jax.tree.structure(examples))
                found[name] = f and native.make_once(_equations_of, f, (self.prepares, axes), examples, read)
            return found

    def _examined(self) -> tuple[str, int]:
        """What `Learned.engines` has of this engine."""
        arguments = self._first_step()
        blocks = [slice(0, 1), slice(1, 2)] if self.plan.members == 1 else [slice(None)]  # one member has its own code
        parts = [self._members(arguments, block) for block in blocks]
        with computed_by(self.name, self.plan.threads):
            [loop] = native.loops_of(self._loop.of_all.trace(*parts[0]).jaxpr)
            assert loop is not None
            code = native.machine_code(loop)
        if isinstance(code, str):
            return code, 0
        return self._difference(arguments, parts) if self.name == "native" else "", code.shared

    def _first_step(self) -> tuple[Tree, ...]:
        """The arguments of a first step of a few members."""
        few = _few_members(self.plan)
        given = self._given(few.step, few.members_clock, few.states)
        value = None if few.reduction is None else np.zeros(few.members, few.dtype)
        ends = np.ones(2, loop.step_dtype())
        rests = None if few.rests is None else np.full(ends.shape, few.first_dt / 2, few.dtype)
        spans = Span(0 * ends, ends, rests, np.ones(ends.shape, bool))
        carry = loop.start(few.states, few.first_change(value, None))
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
            with unsupported_if_it_fails(), computed_by(self.name, self.plan.threads):
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

    def start(self) -> tuple[Given, Carry]:
        """What is given for the members, and their carry, on the devices of the plan."""
        plan = self.plan
        step = devices.placed(plan.mesh, plan.step, own=plan.own_step)
        states, clock = devices.placed(plan.mesh, plan.states), plan.members_clock
        if plan.own_times:
            clock = clock._replace(t0=states.t)  # pyright: ignore
        given = self._given(step, clock, states)
        if plan.reduction is None:
            return given, loop.start(states, None)
        value = self.quantity(plan.reduction, given, states)
        reached = None if plan.condition is None else self.quantity(plan.condition, given, states)
        return given._replace(quantity=value), loop.start(states, plan.first_change(value, reached))

    def _given(self, step: Step, clock: Clock, states: State) -> Given:
        """What is given for members of these steps, clocks and initial states."""
        given = Given(step, None, clock, None)
        return given._replace(step=self.quantity(None, given, states), plain=step) if self.prepares else given

    def quantity(self, function: Reduction | None, given: Given, states: State) -> Tree:
        """A function of step and state, for all members; without one the step with its constants."""
        plain = given._replace(step=given.step if given.plain is None else given.plain, plain=None, quantity=None)
        with computed_by(self.name, self.plan.threads):
            return loop.of_members(function, self._plain)(plain, states)

    def run_intervals(
        self, given: Given, carry: Carry, done: int, saved: int, ends: np.ndarray, rows: int
    ) -> tuple[Carry, Tree]:
        """The carry after the save intervals that end at the nodes `ends`, at most `rows`, and the saved rows.

        Before them there were `done` steps, and `saved` entries after the start.
        """
        dtype, rests, count = loop.step_dtype(), self.plan.rests, len(ends)
        first = np.concatenate([[done], ends[:-1]]).astype(dtype)
        begins = (np.arange(count) > 0) | (done == self.plan.nodes[saved])
        if rests is not None:
            rests = rests[saved + 1 : saved + 1 + count].astype(self.plan.dtype)
        rows = rows if self.name == "xla" else power_of_two(rows)  # XLA's loops fill all rows
        places = np.arange(rows) % count
        spans = jax.tree.map(lambda x: x[places], Span(first, ends.astype(dtype), rests, begins))
        with computed_by(self.name, self.plan.threads):
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


def _few_members(plan: Plan) -> Plan:
    """The plan of a few members and of a copy of each of them that differs by rounding."""
    chosen = np.unique(np.linspace(0, plan.members - 1, _FEW).astype(int))
    few, n = plan.select(np.tile(chosen, 2)), len(chosen)

    def changed(x: np.ndarray) -> np.ndarray:
        if x.dtype.kind == "f":
            largest = np.abs(x[n:]).max(axis=tuple(range(1, x.ndim)), keepdims=True, initial=0)
            pattern = np.cos(1.0 + np.arange(x[n:].size)).reshape(x[n:].shape)
            x[n:] += (_CHANGE * np.finfo(x.dtype).eps * largest * pattern).astype(x.dtype)
        return x

    return replace(few, states=jax.tree.map(changed, few.states)._replace(t=few.states.t))


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
