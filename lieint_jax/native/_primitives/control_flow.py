"""Loops, branches and calls. Loops stay loops, unless they are short.

JAX's releases differ in the parameters of these primitives. So constants, carries and rows are recognized by the number
and the shapes of operands and results, and the function of a call is the only jaxpr among its parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from lieint_jax.native._primitives.abstract_walk import (
    AbstractWalk,
    Arrays,
    Parameters,
    Shapes,
    array_of,
    as_numbers,
    row_of,
    shapes_of,
)
from lieint_jax.native._primitives.elementwise import MOVES, stack
from lieint_jax.native._primitives.indexing import empty_rows, rows_of, write_rows
from lieint_jax.native._primitives.reductions import reduce_terms
from lieint_jax.native._program import Value

_UNROLLED = 4  # the longest counted loop that is unrolled in any case
_MOST_STACKED = 8192  # the most numbers of each member that all loops write to memory, without those of maps


def _while(walk: AbstractWalk, inputs: Arrays, parameters: Parameters, out: Shapes) -> Arrays:
    cond, body = parameters["cond_jaxpr"], parameters["body_jaxpr"]
    of_test, of_body, starts = split_while(inputs, cond, body, out)

    def tests(carry: Arrays) -> np.ndarray:
        return walk.jaxpr(cond, [*of_test, *carry])[0]

    def test(carry: Arrays) -> Value:
        return reduce_terms(walk, "or", list(as_numbers(tests(carry)).flat), np.dtype(bool))

    def next_carry(carry: Arrays) -> Arrays:
        after = walk.jaxpr(body, [*of_body, *carry])
        which = as_numbers(tests(carry))
        if not which.ndim:
            return after
        pairs = zip(map(as_numbers, walk.matched(after, out)), map(as_numbers, carry), strict=True)
        return [_select_entries(walk, which, *pair) for pair in pairs]

    return walk.loop_over_arrays(walk.matched(starts, out), test, next_carry)


def split_while(inputs: list[Any], cond: ClosedJaxpr, body: ClosedJaxpr, out: Sequence[Any]) -> list[list[Any]]:
    """What belongs to the constants of the test, to those of the body, and to the carries."""
    return _split(inputs, len(cond.in_avals) - len(out), len(body.in_avals) - len(out))


def _split(inputs: list[Any], *lengths: int) -> list[list[Any]]:
    """Parts of these lengths, and the rest."""
    ends = [0, *itertools.accumulate(lengths), len(inputs)]
    return [inputs[start:end] for start, end in itertools.pairwise(ends)]


def _select_entries(walk: AbstractWalk, which: np.ndarray, after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The values carried by a loop that has a test for each entry of the leading axes."""
    found = np.empty(after.shape, object)
    for index in np.ndindex(after.shape):
        test: Any = which[index[: which.ndim]]
        found[index] = walk.select(test, after[index], before[index])
    return found


def _scan(walk: AbstractWalk, inputs: Arrays, parameters: Parameters, out: Shapes) -> Arrays:
    length, closed = parameters["length"], parameters["jaxpr"]
    consts, starts, series = split_scan(inputs, closed, inputs, out)
    starts = walk.matched(starts, out)
    order = range(length)[::-1] if parameters["reverse"] else range(length)
    stacked = [x.shape[1:] for x in out[len(starts) :]]
    size = length * sum(int(np.prod(x)) // (1 if (d := walk.long_axis(x)) is None else x[d]) for x in stacked)
    is_short = length <= _UNROLLED or length * _size(closed.jaxpr) <= walk.unrolled * walk.rows_at_once
    if is_short or walk.builder.stacked + size > _MOST_STACKED:
        carry, rows, arrays = starts, [], [_arrays(as_numbers(x)) for x in series]
        for k in order:
            found = walk.jaxpr(closed, [*consts, *carry, *(x[k] for x in arrays)])
            carry = walk.matched(found[: len(starts)], out)
            rows.append(found[len(starts) :])
        if not stacked:
            return carry
        if not length:
            return [*carry, *(array_of([], (0, *x)) for x in stacked)]
        rows = rows[::-1] if parameters["reverse"] else rows
        return [*carry, *(stack(*map(as_numbers, column), axis=0) for column in zip(*rows, strict=True))]
    walk.builder.stacked += size
    zero, one, end = map(walk.index, (0, 1, length))
    kinds = [x.dtype for x in out[len(starts) :]]
    starts_of_rows = [empty_rows(walk, length, *pair) for pair in zip(stacked, kinds, strict=True)]

    def next_carry(carry: Arrays) -> Arrays:
        k = carry[0].item()
        at = walk.number("sub", walk.index(length - 1), k) if parameters["reverse"] else k
        rows = [row_of(walk, x, at) for x in series]
        after = walk.jaxpr(closed, [*consts, *carry[1 : len(starts) + 1], *rows])
        written = [
            write_rows(walk, *pair, at) for pair in zip(carry[len(starts) + 1 :], after[len(starts) :], strict=True)
        ]
        return [array_of([walk.number("add", k, one)], ()), *after[: len(starts)], *written]

    found = walk.loop_over_arrays(
        [array_of([zero], ()), *starts, *starts_of_rows],
        lambda c: walk.number("lt", c[0].item(), end),
        next_carry,
    )[1:]
    rows = zip(found[len(starts) :], stacked, strict=True)
    return [*found[: len(starts)], *(rows_of(walk, length, *pair) for pair in rows)]


def split_scan(items: list[Any], step: ClosedJaxpr, inputs: Sequence[Any], out: Sequence[Any]) -> list[list[Any]]:
    """What belongs to the constants of a scan with these operands and results, to its carries and to its rows."""
    carried = sum(map(have_same_rank, out, step.out_avals))  # rows have an axis more outside of the loop
    fixed = sum(map(have_same_rank, inputs, step.in_avals))
    return _split(items, fixed - carried, carried)


def have_same_rank(x: Any, y: Any) -> bool:
    return len(x.shape) == len(y.shape)


def _arrays(x: np.ndarray) -> np.ndarray:
    return x if x.ndim > 1 else array_of([array_of([y], ()) for y in x.flat], x.shape)


def _cond(walk: AbstractWalk, inputs: Arrays, parameters: Parameters, out: Shapes) -> Arrays:
    index, operands, branches = as_numbers(inputs[0]).item(), inputs[1:], parameters["branches"]
    if index.is_constant:
        return walk.matched(walk.jaxpr(branches[min(max(int(index.data), 0), len(branches) - 1)], operands), out)
    return _branches(walk, index, branches, list(map(as_numbers, operands)), out)


def _branches(
    walk: AbstractWalk, index: Value, branches: Sequence[ClosedJaxpr], operands: Arrays, out: Shapes
) -> Arrays:
    """The results of the branch of number `index`."""
    if len(branches) == 1:
        return walk.matched(walk.jaxpr(branches[0], operands), out)
    if index.dtype == bool:
        test = walk.number("not", index)
    else:
        test = walk.number("le", index, walk.builder.constant(0, index.dtype))
    rest = index if index.dtype == bool else walk.number("sub", index, walk.builder.constant(1, index.dtype))

    def side(index: Value, branches: Sequence[ClosedJaxpr]) -> list[Value]:
        return [x for array in _branches(walk, index, branches, operands, out) for x in as_numbers(array).flat]

    left = iter(walk.builder.branch(test, (lambda: side(index, branches[:1]), lambda: side(rest, branches[1:]))))
    return [array_of([next(left) for _ in range(int(np.prod(x.shape)))], x.shape) for x in out]


def _linear_solve(walk: AbstractWalk, inputs: Arrays, parameters: Parameters, out: Shapes) -> Arrays:
    matvec, vecmat, solve, transpose_solve = parameters["jaxprs"]  # functions of constants and a vector
    lengths = [len(f.in_avals) - len(matvec.out_avals) if f else 0 for f in (matvec, vecmat, solve, transpose_solve)]
    _, _, consts, _, right_side = _split(inputs, *lengths)
    return walk.jaxpr(solve, [*consts, *right_side])


def _size(jaxpr: Any) -> int:
    """About the number of operations of a jaxpr."""
    return sum(map(size_of, jaxpr.eqns))


def size_of(equation: JaxprEqn) -> int:
    """About the number of operations of an equation."""
    inner = jaxprs_of(equation.params)
    if inner:
        repeats = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        return sum(repeats * _size(x) for x in inner)
    return 0 if equation.primitive.name in MOVES else sum(int(np.prod(x.shape)) for x in shapes_of(equation.outvars))


def jaxprs_of(parameters: Parameters) -> list[Any]:
    leaves = jax.tree.leaves(dict(parameters), is_leaf=lambda x: isinstance(x, ClosedJaxpr | Jaxpr))
    return [x for x in leaves if isinstance(x, ClosedJaxpr | Jaxpr)]


def _call(walk: AbstractWalk, inputs: Arrays, parameters: Parameters, out: Shapes) -> Arrays:
    [inner] = jaxprs_of(parameters)
    return walk.jaxpr(inner, inputs)


_CALLS = (
    "checkpoint closed_call core_call custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr custom_vmap_call "
    "eval_jaxpr jit pjit remat remat2"
)
CALLS = _CALLS.split()
READ_ROWS = frozenset({*CALLS, "cond", "custom_linear_solve", "optimization_barrier", "scan", "while"})
CONTROL_FLOW: dict[str, Callable[..., Arrays]] = dict.fromkeys(CALLS, _call) | {
    "while": _while,
    "scan": _scan,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "optimization_barrier": lambda walk, inputs, parameters, out: inputs,
}
