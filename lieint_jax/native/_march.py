"""`march`: a loop over the steps of a pure function, as one primitive of JAX.

It is `jax.lax.scan`, of whose rows only each `every`-th is stored. Members come from `jax.vmap`: the batching rule
(`_march_members`) makes them a parameter, and machine code of one member runs over blocks of them (`_march_code`).
Derivatives are such loops again (`_march_derivatives`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun

from lieint_jax._checks import outermost
from lieint_jax._xla import axis_spread, differ, remembered, result_like, unchecked, with_common_axes

Tree = Any  # a tree of arrays
AnyArray = Any  # an array, or what stands for one in JAX: a tracer, a shape, a tangent
AnyArrays = Sequence[AnyArray]
Arrays = list[AnyArray]
march_p = Primitive("march")
march_p.multiple_results = True


class Deferred:
    """A step that JAX traces when it is first needed: of tangents, reverse mode needs the shapes only.

    Attributes:
        in_avals, out_avals: as those of a jaxpr.
    """

    def __init__(self, function: Callable[..., AnyArrays], arguments: AnyArrays, results: AnyArrays):
        self._function = function
        self.in_avals = [ShapedArray(x.shape, x.dtype) for x in arguments]
        self.out_avals = [ShapedArray(x.shape, x.dtype) for x in results]

    @functools.cached_property
    def jaxpr(self) -> ClosedJaxpr:
        """The step."""
        return jax.make_jaxpr(self._function)(*map(shape_of, self.in_avals))


def jaxpr_of(step: ClosedJaxpr | Deferred) -> ClosedJaxpr:
    """A step as a jaxpr."""
    return step.jaxpr if isinstance(step, Deferred) else step


def function_of(step: ClosedJaxpr | Deferred) -> Callable[..., Arrays]:
    """A step as a function of arrays."""
    return lambda *arguments: list(jaxpr_as_fun(jaxpr_of(step))(*arguments))


def with_results(step: ClosedJaxpr | Deferred, results: Callable[[AnyArrays, AnyArrays], AnyArrays]) -> ClosedJaxpr:
    """A step with other results: those of (its arguments, its results)."""
    closed = jaxpr_of(step)
    inner, unnamed = closed.jaxpr, closed.jaxpr.debug_info.with_unknown_names()
    return ClosedJaxpr(
        inner.replace(outvars=results(inner.invars, inner.outvars), debug_info=unnamed), list(closed.consts)
    )


@functools.lru_cache(32)
def without_results(step: ClosedJaxpr | Deferred, carried: int) -> ClosedJaxpr:
    """A step that changes the carries only."""
    return with_results(step, lambda _, results: results[:carried])


@functools.lru_cache(32)
def ends_that_are_results(step: ClosedJaxpr | Deferred, carried: int) -> tuple[int, ...] | None:
    """For each result of a step, the place of the carry that it is, too; None if one is no carry."""
    out = list(map(id, jaxpr_of(step).jaxpr.outvars))
    return tuple(map(out.index, out[carried:])) if set(out[carried:]) <= set(out[:carried]) else None


class Origin(NamedTuple):
    """The loop of which another is the derivative.

    Attributes:
        loop: the loop.
        active: for each of its arguments, whether it has a tangent.
        linear: True if the derivative is taken at stored states, so that it is linear in all that it carries.
    """

    loop: Loop
    active: tuple[bool, ...]
    linear: bool


class Loop(NamedTuple):
    """A loop of `rows` × `every` steps; its arguments are the carries, the constants, and the rows of each step.

    If `every` is None, it is counted: its first constants, of which a step makes no use, are `every` and how many of
    the `rows` are run. Then rows may be given if `every` is 1, and the stored rows that are not run are undefined.

    Attributes:
        step: a step, (n, carries, constants, a row) ↦ (carries, results), with n = 0, 1, …, of one member.
        carried, fixed: the numbers of carries and of constants.
        rows: the number of rows of results that are stored.
        every: the number of steps for each of them, or None.
        reverse: whether the last step comes first.
        members: the number of members; None if the arrays have no axis of members.
        own: for each constant and each array of rows, whether each member has its own.
        origin: of what loop it is the derivative, if it is one.
        is_piece: whether it is a piece of a longer loop, of which reverse mode stores the carries before all steps.
    """

    step: ClosedJaxpr | Deferred
    carried: int
    fixed: int
    rows: int
    every: int | None
    reverse: bool
    members: int | None = None
    own: tuple[bool, ...] = ()
    origin: Origin | None = None
    is_piece: bool = False

    @property
    def known_every(self) -> int:
        """The number of steps for each row, of a loop that is not counted."""
        assert self.every is not None
        return self.every

    @property
    def steps(self) -> int:
        """The number of steps of a loop that is not counted."""
        return self.rows * self.known_every

    @property
    def one_step(self) -> Loop:
        """A single step without members, on which alone that of a derivative depends."""
        return Loop(self.step, self.carried, self.fixed, 1, 1, False)

    @property
    def owns(self) -> tuple[bool, ...]:
        """For each argument, whether each member has its own."""
        return (self.members is not None,) * self.carried + self.own

    def split(self, items: AnyArrays) -> tuple[Arrays, Arrays, Arrays]:
        """What belongs to the carries, to the constants and to the rows."""
        ends = self.carried, self.carried + self.fixed
        return list(items[: ends[0]]), list(items[ends[0] : ends[1]]), list(items[ends[1] :])

    def is_series(self, k: int) -> bool:
        """Whether argument k has an axis of steps."""
        return k >= self.carried + self.fixed

    def bind(self, arguments: AnyArrays) -> Arrays:
        """The carries after the last step, and the stored rows of results, of axes (rows, members, …)."""
        return march_p.bind(*with_common_axes(arguments), loop=self)


def shape_of(x: AnyArray) -> jax.ShapeDtypeStruct:
    """The shape and type of an array, a tracer or an abstract value."""
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def march(
    step: Callable[..., tuple[Tree, Tree]] | TracedStep,
    carry: Tree,
    xs: Tree = None,
    consts: Sequence[Tree] | None = None,
    *,
    rows: int | AnyArray,
    every: int | AnyArray = 1,
    most: int | None = None,
    reverse: bool = False,
) -> tuple[Tree, Tree]:
    """The carry after rows × every steps, carry, y = step(n, carry, x, *consts), and the last y of each row.

    Args:
        step: a pure function, or what it was traced into. Traced arrays that it closes over become arguments of the
            loop.
        carry, xs: trees of arrays; those of xs have a leading axis of steps.
        consts: trees of arrays. With them a step closes over no traced array, and JAX traces equal ones once.
        rows, every, reverse: see `Loop`. If one of the numbers is an array, one program serves all; then there is no
            derivative in reverse mode, there are xs only if `every` is 1, and, if `every` is 0, undefined rows of y.
            Under vmap `every` may differ from member to member where a step returns no y.
        most: the length of the rows of y and of xs, of which those beyond `rows` are undefined; needed if `rows` is an
            array.
    """
    carry, xs, given = jax.tree.map(_strong, (carry, xs, consts or ()))
    known = isinstance(rows, int) and isinstance(every, int) and most is None
    stored: Any = rows if most is None else most
    count = [] if known else [jnp.asarray(every, jnp.int32), jnp.minimum(jnp.asarray(rows, jnp.int32), stored)]
    if not isinstance(step, TracedStep):
        step = traced_step(step, carry, xs, count, given, consts is not None)
    _check_carry(carry, step.after)
    closed = step.jaxpr
    starts, fixed, has_effects = jax.tree.leaves(carry), [*count, *jax.tree.leaves(given)], bool(closed.effects)
    closed, closed_over = _with_arguments(closed, 1 + len(starts) + len(fixed))
    fixed += closed_over
    arguments = [*starts, *fixed, *jax.tree.leaves(xs)]
    own = (False,) * (len(arguments) - len(starts))
    loop = Loop(closed, len(starts), len(fixed), stored, None if count else every, reverse, own=own)
    ends = ends_that_are_results(closed, len(starts)) if stored == 1 else None
    if ends is not None:
        loop = loop._replace(step=without_results(closed, len(starts)))
    found = by_xla(*arguments, loop=loop) if has_effects else loop.bind(arguments)  # such as jax.debug.print
    ys = found[len(starts) :] if ends is None else [found[k][None] for k in ends]
    ends = jax.tree.unflatten(jax.tree.structure(carry), found[: len(starts)])
    return ends, jax.tree.unflatten(step.results, ys)


class TracedStep(NamedTuple):
    """A step of a loop after JAX has traced it.

    Attributes:
        jaxpr: the step.
        after: the types of the carry that it returns.
        results: the structure of y.
    """

    jaxpr: ClosedJaxpr
    after: Tree
    results: Tree


def traced_step(
    step: Callable[..., tuple[Tree, Tree]],
    carry: Tree,
    xs: Tree,
    count: Sequence[AnyArray] = (),
    consts: Sequence[Tree] = (),
    is_closed: bool = False,
) -> TracedStep:
    """A step for arguments of these types; the one of before where it can close over no tracer."""
    row = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
    number = jax.ShapeDtypeStruct((), jnp.int64 if jax.config.jax_enable_x64 else jnp.int32)  # pyright: ignore
    shapes = number, *jax.tree.map(shape_of, (carry, list(count), tuple(consts))), row
    with unchecked():
        if is_closed or outermost():
            traced = _jitted_step(step).trace(*shapes)
            closed, out = traced.jaxpr, traced.out_info
        else:  # by a new function, or JAX may return what it has traced before
            closed, out = jax.make_jaxpr(_with_structure(step), return_shape=True)(*shapes)
    after, y = jax.tree.unflatten(jax.tree.structure(out), closed.out_avals)
    return TracedStep(closed, after, jax.tree.structure(y))


@remembered(12)
def _jitted_step(step: Callable[..., tuple[Tree, Tree]]) -> Any:
    return jax.jit(_with_structure(step))


def _with_structure(step: Callable[..., tuple[Tree, Tree]]) -> Callable[..., tuple[Tree, Tree]]:
    """A step that returns (carry, y), with a carry of the structure of the one before."""

    def checked(n: AnyArray, carry: Tree, count: Arrays, consts: tuple[Tree, ...], x: Tree) -> tuple[Tree, Tree]:
        result = step(n, carry, x, *consts)
        try:
            after, y = result
        except (TypeError, ValueError):
            raise ValueError(f"a step must return (carry, y), got {type(result).__name__}") from None
        given, found = jax.tree.structure(carry), jax.tree.structure(after)
        if given != found:
            raise ValueError(f"a step must return a carry of the structure that it was given, {given}, got {found}")
        return after, y

    return checked


def _check_carry(before: Tree, after: Tree) -> None:
    """Raise ValueError if a step returns a carry of other shapes or types."""
    for (path, x), z in zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True):
        if x.shape != z.shape or x.dtype != z.dtype:
            raise ValueError(
                f"carry{jax.tree_util.keystr(path)} was {x.dtype} of shape {x.shape}; a step returned {z.dtype} of "
                f"shape {z.shape}"
            )


def _strong(x: AnyArray) -> AnyArray:
    """An array that does not take the type of another."""
    x = jnp.asarray(x)
    return lax.convert_element_type(x, x.dtype)


def _with_arguments(closed: ClosedJaxpr, place: int) -> tuple[ClosedJaxpr, Arrays]:
    """A jaxpr in which the tracers that it closes over are arguments, from position `place` on; and these tracers."""
    consts, inner = list(closed.consts), closed.jaxpr
    traced = [isinstance(x, Tracer) for x in consts]
    if not any(traced):
        return closed, []
    moved, kept = ([v for v, t in zip(inner.constvars, traced, strict=True) if t == which] for which in (True, False))
    invars, unnamed = [*inner.invars[:place], *moved, *inner.invars[place:]], inner.debug_info.with_unknown_names()
    made = inner.replace(constvars=kept, invars=invars, debug_info=unnamed)
    tracers = [x for x, t in zip(consts, traced, strict=True) if t]
    return ClosedJaxpr(made, [x for x, t in zip(consts, traced, strict=True) if not t]), tracers


def hoisted(function: Callable[..., Tree], *examples: Tree) -> tuple[Callable[..., Tree], Arrays]:
    """A function as one of the tracers that it closes over, (tracers, arguments) ↦ results; and these tracers.

    It is traced once: calls, and their derivatives, evaluate its jaxpr.
    """
    with unchecked():
        closed, out = jax.make_jaxpr(function, return_shape=True)(*jax.tree.map(shape_of, examples))
    closed, tracers = _with_arguments(closed, 0)

    def explicit(tracers: AnyArrays, *arguments: Tree) -> Tree:
        given = [*tracers, *jax.tree.leaves(arguments)]
        if differ(given):  # of which the jaxpr has no types: as a loop of one step
            one_step = march(lambda _, given, x: (given, jaxpr_as_fun(closed)(*given)), given, rows=1)[1]
            found = [x[0] for x in one_step]
        else:
            found = jaxpr_as_fun(closed)(*given)
        return jax.tree.unflatten(jax.tree.structure(out), found)

    return explicit, tracers


@march_p.def_abstract_eval
def _shapes(*given: ShapedArray, loop: Loop) -> list[ShapedArray]:
    lead = () if loop.members is None else (loop.members,)
    of_members = (axis_spread(x, loop.is_series(k)) for k, x in enumerate(given) if lead and loop.owns[k])
    spread = next((x for x in of_members if x is not None), None)
    rows = [()] * loop.carried + [(loop.rows,)] * (len(loop.step.out_avals) - loop.carried)
    return [
        result_like(given, (*r, *lead, *x.shape), x.dtype, len(r) if lead else None, spread)
        for r, x in zip(rows, loop.step.out_avals, strict=True)
    ]


@march_p.def_impl
def _evaluate(*arguments: AnyArray, loop: Loop) -> Arrays:
    return _jitted(loop)(*arguments)


@functools.lru_cache(64)
def _jitted(loop: Loop) -> Callable[..., Arrays]:
    return jax.jit(lambda *arguments: loop.bind(arguments))


def by_xla(*arguments: AnyArray, loop: Loop) -> Arrays:
    """The loop by XLA: over rows, and in each over its steps."""
    carry, fixed, series = loop.split(arguments)
    step, number = function_of(loop.step), loop.step.in_avals[0].dtype
    if loop.members is not None:
        axes = [0 if own else None for own in loop.owns]
        step = jax.vmap(step, (None, *axes), 0, axis_size=loop.members)
    every, count = (loop.every, loop.rows) if loop.every is not None else (x.astype(number) for x in fixed[:2])

    def in_order(k: AnyArray, count: int | AnyArray) -> AnyArray:
        return count - 1 - k if loop.reverse else k

    def row(k: AnyArray, both: tuple[Arrays, Arrays]) -> tuple[Arrays, Arrays]:
        k = in_order(k, count)

        def next_step(i: AnyArray, both: tuple[Arrays, Arrays]) -> tuple[Arrays, Arrays]:
            n = jnp.asarray(k * every + in_order(i, every), number)
            rows = [lax.dynamic_index_in_dim(x, n, keepdims=False) for x in series]
            found = list(step(n, *both[0], *fixed, *rows))
            return found[: loop.carried], found[loop.carried :]

        carry, y = lax.fori_loop(0, every, next_step, (both[0], empty))
        return carry, [lax.dynamic_update_index_in_dim(ys, y, k, 0) for ys, y in zip(both[1], y, strict=True)]

    lead = () if loop.members is None else (loop.members,)
    empty = [jnp.zeros((*lead, *x.shape), x.dtype) for x in loop.step.out_avals[loop.carried :]]
    both = carry, [jnp.zeros((loop.rows, *x.shape), x.dtype) for x in empty]
    if 0 not in (loop.rows, loop.every):
        both = lax.fori_loop(0, count, row, both)
    return [*both[0], *both[1]]
