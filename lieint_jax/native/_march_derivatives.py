"""Derivatives of `march`, which are such loops again.

Forward mode is a loop of the step and its tangents. Reverse mode stores the carries before all steps, if these are few;
then the tangents are a loop that is linear in what it carries, and whose transpose runs backward through the stored
carries. Of many steps it stores the carries before pieces of about √steps, and computes each piece again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, DropVar, JaxprEqn, Var, new_jaxpr_eqn, set_current_trace
from jax.interpreters import ad, partial_eval

from lieint_jax._xla import with_common_mesh
from lieint_jax.native._march import (
    AnyArray,
    AnyArrays,
    Arrays,
    Deferred,
    Loop,
    Origin,
    ends_that_are_results,
    function_of,
    jaxpr_of,
    march_p,
    with_results,
    without_results,
)
from lieint_jax.native._march_members import varying_in_loop

_MOST_STORED = 64  # steps of a loop whose carries are all stored
Mask = Sequence[bool]
_Function = Callable[..., Arrays]
_Step = ClosedJaxpr | Deferred


def _chosen(items: AnyArrays, mask: Mask) -> Arrays:
    return [x for x, m in zip(items, mask, strict=True) if m]


def _is_real(x: AnyArray) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


@functools.lru_cache(32)
def _mask_of_results(step: _Step, carried: int, active: tuple[bool, ...]) -> tuple[bool, ...]:
    """Which results have tangents, if those arguments have them."""
    varying = varying_in_loop(jaxpr_of(step), [False, *active], 1, carried)
    return tuple(v and _is_real(x) for v, x in zip(varying, step.out_avals, strict=True))


# Forward mode ---------------------------------------------------------------------------------------------------------


def _jvp(primals: AnyArrays, tangents: AnyArrays, *, loop: Loop) -> tuple[Arrays, Arrays]:
    primals = [jnp.asarray(x) for x in primals]  # JAX passes on Python's numbers
    given = tuple(type(t) is not ad.Zero and _is_real(x) for x, t in zip(primals, tangents, strict=True))
    real = _mask_of_results(loop.step, loop.carried, given)
    active = (*real[: loop.carried], *given[loop.carried :])
    dots = [ad.instantiate_zeros(t) for t, a in zip(tangents, active, strict=True) if a]
    found = _derivative(loop, active).bind(_joined(loop, active, primals, dots))
    out, slopes = _parted(loop._replace(fixed=0), real, found)
    left = iter(slopes)
    pairs = zip(out, real, strict=True)
    return out, [next(left) if m else ad.Zero(jax.typeof(x).to_tangent_aval()) for x, m in pairs]


ad.primitive_jvps[march_p] = _jvp


def _places(loop: Loop, active: Mask, linear: bool) -> list[int]:
    """The order of the arguments of a derivative among those of its loop and, after these, their tangents.

    Of carries, constants and rows first the plain ones, then their tangents. If it is linear, plain carries are rows.
    """
    carries, fixed, rows = loop.split(range(len(active)))
    numbers = iter(range(len(active), len(active) + sum(active)))
    of_carries, of_fixed, of_rows = ([next(numbers) for m in mask if m] for mask in loop.split(active))
    carries, stored = ([], carries) if linear else (carries, [])
    return [*carries, *of_carries, *fixed, *of_fixed, *stored, *rows, *of_rows]


def _joined(loop: Loop, active: Mask, plain: AnyArrays, dots: AnyArrays, linear: bool = False) -> Arrays:
    """The arguments of a derivative, from those of its loop and their tangents; without constants its results."""
    both = [*plain, *dots]
    return [both[k] for k in _places(loop, active, linear)]


def _parted(loop: Loop, active: Mask, items: AnyArrays, linear: bool = False) -> tuple[Arrays, Arrays]:
    """What `_joined` put together: the plain items, and those of the tangents."""
    both = dict(zip(_places(loop, active, linear), items, strict=True))
    found = [both[k] for k in range(len(both))]
    return found[: len(active)], found[len(active) :]


def _derivative(loop: Loop, active: tuple[bool, ...], linear: bool = False) -> Loop:
    """The loop of the step and its tangents; if it is linear, of the tangents alone, at stored carries."""
    carries, fixed, _ = loop.split(active)
    carried = sum(carries) + (0 if linear else loop.carried)
    owns = _joined(loop, active, loop.owns, _chosen(loop.owns, active), linear)
    return loop._replace(
        step=_step_of_derivative(loop.one_step, active, linear),
        carried=carried,
        fixed=loop.fixed + sum(fixed),
        own=tuple(owns[carried:]),
        origin=Origin(loop, active, linear),
    )


@functools.lru_cache(64)
def _step_of_derivative(loop: Loop, active: tuple[bool, ...], linear: bool) -> Deferred:
    mask = _mask_of_results(loop.step, loop.carried, active)
    function, shapes = function_of(loop.step), loop.step.in_avals[1:]

    def results(out: AnyArrays, slopes: AnyArrays) -> Arrays:
        slopes = _chosen(slopes, mask)
        return slopes if linear else _results_of(loop, active, out, slopes)

    def pushed(n: AnyArray, *arguments: AnyArray) -> Arrays:
        plain, dots = _parted(loop, active, arguments, linear)
        of_active = _of_active(function, n, plain, active)
        return results(*jax.jvp(of_active, tuple(_chosen(plain, active)), tuple(dots)))

    arguments = _joined(loop, active, shapes, _chosen(shapes, active), linear)
    return Deferred(pushed, [loop.step.in_avals[0], *arguments], results(*[loop.step.out_avals] * 2))


def _of_active(function: _Function, n: AnyArray, plain: AnyArrays, active: Mask) -> _Function:
    """A step as a function of its active arguments."""

    def of_active(*values: AnyArray) -> Arrays:
        left = iter(values)
        return list(function(n, *(next(left) if a else x for a, x in zip(active, plain, strict=True))))

    return of_active


# Reverse mode ---------------------------------------------------------------------------------------------------------


def _partial_eval(trace: Any, *tracers: AnyArray, loop: Loop) -> Arrays:
    """A loop with known primals and unknown tangents: the primals now, and equations for the tangents."""
    origin = loop.origin
    if origin is None or origin.linear:
        return trace.default_process_primitive(march_p, tracers, {"loop": loop})
    base, active = origin.loop, origin.active
    plain, dots = _parted(base, active, tracers)
    if not all(x.is_known() for x in plain) or all(x.is_known() for x in dots):
        return trace.default_process_primitive(march_p, tracers, {"loop": loop})
    known = [jnp.asarray(x.pval.get_known()) for x in plain]
    dots = [trace.instantiate_const(x) for x in dots]
    if base.every is None:
        out = [trace.new_const(x) for x in base.bind(known)]
        found = trace.default_process_primitive(march_p, tracers, {"loop": loop})
        slopes = _parted(base._replace(fixed=0), _mask_of_results(base.step, base.carried, active), found)[1]
        return _results_of(base, active, out, slopes)
    if base.steps > _MOST_STORED and not base.is_piece:
        with set_current_trace(trace):
            of_active = _of_active(lambda _, *x: _in_pieces(base, *x), None, known, active)
            out, out_dots = jax.jvp(of_active, tuple(_chosen(known, active)), tuple(dots))
        slopes = _chosen(out_dots, _mask_of_results(base.step, base.carried, active))
        out, slopes = ([trace.to_jaxpr_tracer(x) for x in values] for values in (out, slopes))
    else:
        out, stored = _recorded(base, known)
        linear = _derivative(base, active, linear=True)
        given = _joined(base, active, [*stored, *known[base.carried :]], dots, linear=True)
        given = [x if isinstance(x, type(dots[0])) else trace.new_instantiated_const(x) for x in given]
        slopes = trace.default_process_primitive(march_p, given, {"loop": linear})
        out = [trace.new_const(x) for x in out]
    return _results_of(base, active, out, slopes)


partial_eval.custom_partial_eval_rules[march_p] = _partial_eval


def _results_of(loop: Loop, active: tuple[bool, ...], out: AnyArrays, slopes: AnyArrays) -> Arrays:
    """The results of the loop of the step and its tangents: (carries, their tangents, results, their tangents)."""
    return _joined(loop._replace(fixed=0), _mask_of_results(loop.step, loop.carried, active), out, slopes)


def _recorded(loop: Loop, arguments: AnyArrays) -> tuple[Arrays, Arrays]:
    """The results of a loop, and the carries before all steps."""
    recording = loop._replace(step=_recording(loop.step, loop.carried), rows=loop.steps, every=1, origin=None)
    found = recording.bind(arguments)
    count = len(loop.step.out_avals)
    ys = found[loop.carried : count]
    last = slice(0 if loop.reverse else loop.known_every - 1, None, loop.known_every)
    return [*found[: loop.carried], *(y[last] for y in ys)], found[count:]


@functools.lru_cache(32)
def _recording(step: _Step, carried: int) -> ClosedJaxpr:
    """The step with the carries before it among its results."""
    return with_results(step, lambda arguments, results: [*results, *arguments[1 : 1 + carried]])


def _transpose(bars: AnyArrays, *arguments: AnyArray, loop: Loop) -> Arrays:
    """The cotangents of the arguments of a linear loop: a loop in the other direction."""
    if loop.origin is None or not loop.origin.linear:
        if loop.every is not None:
            raise NotImplementedError("the transpose of a loop that is not linear in what it carries")
        raise ValueError("reverse mode needs a loop whose number of steps is known when JAX traces it")
    base, active = loop.origin.loop, loop.origin.active
    carries, fixed, rows = base.split(active)
    _, own_fixed, own_rows = base.split(base.owns)
    stored, constants, series = base.split(_parted(base, active, arguments, linear=True)[0])
    n = sum(carries)
    lam, y_bars = [ad.instantiate_zeros(x) for x in bars[:n]], bars[n:]
    seen = tuple(type(x) is not ad.Zero for x in y_bars)
    y_bars = [_spread(x, loop) for x, s in zip(y_bars, seen, strict=True) if s]
    has_members = loop.members is not None
    lead = (loop.members,) if has_members else ()
    sums = [jnp.zeros((*lead, *x.shape), x.dtype) for x in _chosen(base.split(base.step.in_avals[1:])[1], fixed)]
    back = Loop(
        _backward_step(base.one_step, active, seen),
        len(lam) + len(sums),
        base.fixed,
        loop.steps,
        1,
        not loop.reverse,
        loop.members,
        (*own_fixed, *[has_members] * base.carried, *own_rows, *[has_members] * len(y_bars)),
        is_piece=loop.is_piece,
    )
    found = back.bind([*lam, *sums, *constants, *stored, *series, *y_bars])
    lam, sums, x_bars = found[:n], found[n : n + len(sums)], found[n + len(sums) :]
    if has_members:
        sums = [x if own else x.sum(0) for x, own in zip(sums, _chosen(own_fixed, fixed), strict=True)]
        x_bars = [x if own else x.sum(1) for x, own in zip(x_bars, _chosen(own_rows, rows), strict=True)]
    return _joined(base, active, [None] * len(active), [*lam, *sums, *x_bars], linear=True)


ad.primitive_transposes[march_p] = _transpose


def _spread(y_bar: AnyArray, loop: Loop) -> AnyArray:
    """Cotangents of the stored rows, as those of all steps."""
    if loop.known_every == 1:
        return y_bar
    zeros = jnp.zeros((loop.rows, loop.known_every, *y_bar.shape[1:]), y_bar.dtype)
    return zeros.at[:, 0 if loop.reverse else -1].set(y_bar).reshape(loop.steps, *y_bar.shape[1:])


@functools.lru_cache(32)
def _backward_step(loop: Loop, active: tuple[bool, ...], seen: tuple[bool, ...]) -> Deferred:
    """(λ, sums, constants, carries before it, row, cotangents of results) ↦ (λ, sums, cotangents of the row)."""
    step, carried, fixed = loop[:3]
    mask, function = _mask_of_results(loop.step, loop.carried, active), function_of(step)
    carries, of_fixed, of_rows = loop.split(active)
    n, m = sum(carries), sum(carries) + sum(of_fixed)
    results = iter(seen)
    wanted = [*mask[:carried], *(r and next(results) for r in mask[carried:])]

    def pulled(number: AnyArray, *arguments: AnyArray) -> Arrays:
        lam, sums, constants = arguments[:n], arguments[n:m], arguments[m : m + fixed]
        values, bars = arguments[m + fixed :][: len(active) - fixed], arguments[m + len(active) :]
        plain = [*values[:carried], *constants, *values[carried:]]
        of_active = _of_active(function, number, plain, active)
        _, pull = jax.vjp(lambda *x: _chosen(of_active(*x), wanted), *_chosen(plain, active))
        found = pull([*lam, *bars])
        return [*found[:n], *(a + b for a, b in zip(sums, found[n:m], strict=True)), *found[m:]]

    c, k, x = loop.split(step.in_avals[1:])
    ys = _chosen(step.out_avals[carried:], wanted[carried:])
    bars = [*_chosen(c, carries), *_chosen(k, of_fixed)]
    return Deferred(pulled, [step.in_avals[0], *bars, *k, *c, *x, *ys], [*bars, *_chosen(x, of_rows)])


def _partial_eval_of_equation(
    saveable: object, unknown: Mask, instantiated: Mask, equation: JaxprEqn
) -> tuple[JaxprEqn | None, JaxprEqn | None, Mask, Mask, list[Var]]:
    """`_partial_eval` for an equation in `jax.checkpoint`, which computes the primals again for the tangents."""
    loop = equation.params["loop"]
    origin, out = loop.origin, equation.outvars
    more = [x for x, i in zip(equation.invars, instantiated, strict=True) if not i and isinstance(x, Var)]
    if origin is None or origin.linear or any(_parted(origin.loop, origin.active, unknown)[0]):
        return None, equation, [True] * len(out), [True] * len(out), more
    base, active = origin.loop, origin.active
    mask = _mask_of_results(base.step, base.carried, active)
    dots = _results_of(base, active, [False] * len(mask), [True] * sum(mask))
    primals = [x for x, d in zip(out, dots, strict=True) if not d]
    inputs, loops = _parted(base, active, equation.invars)[0], {"loop": base}
    known = new_jaxpr_eqn(inputs, primals, march_p, loops, equation.effects, equation.source_info)
    staged = equation.replace(outvars=[x if d else DropVar(x.aval) for x, d in zip(out, dots, strict=True)])
    return known, staged, dots, dots, more


partial_eval.partial_eval_jaxpr_custom_rules[march_p] = _partial_eval_of_equation


# Many steps -----------------------------------------------------------------------------------------------------------


def _in_pieces(loop: Loop, *arguments: AnyArray) -> Arrays:
    """A loop as a scan over pieces; reverse mode stores the carries before each, and computes all else again."""
    length = math.isqrt(loop.steps - 1) + 1
    carry, fixed, series = loop.split(with_common_mesh(arguments))  # as the results of pieces are, which scan carries
    first = jnp.zeros((), loop.step.in_avals[0].dtype)
    if loop.known_every <= length:
        rows = length // loop.known_every
        return _pieces_and_rest(loop, loop._replace(rows=rows), loop.rows // rows, carry, first, fixed, series)
    silent = loop._replace(step=without_results(loop.step, loop.carried), rows=1, every=length)
    ends = ends_that_are_results(loop.step, loop.carried)
    whole = loop._replace(rows=1) if ends is None else silent._replace(every=loop.every)

    def row(carry: Arrays, given: tuple[AnyArray, Arrays]) -> tuple[Arrays, Arrays]:
        found = _pieces_and_rest(whole, silent, (loop.known_every - 1) // length, carry, given[0], fixed, given[1])
        ys = [y[0] for y in found[loop.carried :]] if ends is None else [found[k] for k in ends]
        return found[: loop.carried], ys

    starts = loop.known_every * jnp.arange(loop.rows, dtype=first.dtype)
    in_rows = [x.reshape(loop.rows, loop.known_every, *x.shape[1:]) for x in series]
    carry, ys = lax.scan(row, carry, (starts, in_rows), reverse=loop.reverse)
    return [*carry, *ys]


def _pieces_and_rest(
    loop: Loop, piece: Loop, count: int, carry: Arrays, first: AnyArray, fixed: Arrays, series: Arrays
) -> Arrays:
    """A loop whose steps are numbered from `first` on, as `count` pieces and a loop of the rest, which comes last."""
    in_pieces, rest = count * piece.steps, loop.steps - count * piece.steps
    place, place_of_rest = (rest, 0) if loop.reverse else (0, in_pieces)
    starts = first + place + piece.steps * jnp.arange(count, dtype=first.dtype)
    cut = [x[place : place + in_pieces].reshape(count, piece.steps, *x.shape[1:]) for x in series]

    @jax.checkpoint
    def run_piece(carry: Arrays, start: AnyArray, rows: Arrays) -> tuple[Arrays, Arrays]:
        found = _numbered(piece).bind([*carry, start, *fixed, *rows])
        return found[: loop.carried], found[loop.carried :]

    found = lax.scan(lambda c, x: run_piece(c, *x), carry, (starts, cut), reverse=loop.reverse)
    # The transpose of a barrier is one: JAX 0.10 fails if the cotangent of `ys` is a symbolic zero
    carry, ys = lax.optimization_barrier(found) if found[1] else found
    ys = [y.reshape(y.shape[0] * y.shape[1], *y.shape[2:]) for y in ys]
    if not rest:
        return [*carry, *ys]
    tail = loop._replace(rows=1, every=rest) if loop.rows == 1 else loop._replace(rows=rest // loop.known_every)
    rows = [x[place_of_rest : place_of_rest + rest] for x in series]
    found = _numbered(tail).bind([*carry, first + place_of_rest, *fixed, *rows])
    more = found[loop.carried :]
    if ys:
        more = [jnp.concatenate((b, a) if loop.reverse else (a, b)) for a, b in zip(ys, more, strict=True)]
    return [*found[: loop.carried], *more]


def _numbered(loop: Loop) -> Loop:
    """A piece of a loop, with the number of its first step as its first constant."""
    step = _numbered_step(loop.step, loop.carried)
    return loop._replace(step=step, fixed=loop.fixed + 1, own=(False, *loop.own), origin=None, is_piece=True)


@functools.lru_cache(32)
def _numbered_step(step: _Step, carried: int) -> Deferred:
    function = function_of(step)
    number, *shapes = step.in_avals

    def numbered(n: AnyArray, *arguments: AnyArray) -> Arrays:
        return function(n + arguments[carried], *arguments[:carried], *arguments[carried + 1 :])

    return Deferred(numbered, [number, *shapes[:carried], number, *shapes[carried:]], step.out_avals)
