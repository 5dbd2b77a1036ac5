"""From a jaxpr to a program of numbers.

An array is a NumPy array of its numbers, so that operations which only move entries cost nothing, and a matrix product
becomes products and sums. Loops stay loops, unless they are short.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jax.typing import ArrayLike, DTypeLike

from lieint_jax.native._program import Builder, Number

Parameters = Mapping[str, Any]  # of a primitive
_UNROLLED = 4  # the longest counted loop that is unrolled in any case
_UNROLLED_NUMBERS = 400  # the most numbers of a longer unrolled loop, in all iterations together
_LONGEST = 60_000  # the most numbers of a program
_LARGEST = 10_000  # the most entries of an array
_SELECTED = 8  # the most numbers from which one is selected by comparing indices; longer arrays are read from memory


def _names(words: str) -> frozenset[str]:
    return frozenset(words.split())


class UnsupportedError(Exception):
    """A function cannot be a program of numbers; the message names the unsupported operation."""


class Table:
    """An array in memory whose entries a program reads by a computed index, such as the times of all steps."""

    def __init__(self, data: int, dtype: DTypeLike, shape: tuple[int, ...]):
        self.data, self.dtype, self.shape = data, np.dtype(dtype), shape

    def __getattr__(self, name: str) -> NoReturn:
        raise UnsupportedError(f"{name} of a long array")


def array_of(numbers: Sequence[object], shape: Sequence[int]) -> np.ndarray:
    """Numbers as an array."""
    found = np.empty(len(numbers), object)
    for k, x in enumerate(numbers):
        found[k] = x
    return found.reshape(shape)


def shapes_of(variables: Sequence[Any]) -> list[ShapedArray]:
    """The shapes and types of variables of a jaxpr."""
    return [x.aval for x in variables]


class Walk:
    """A walk through a jaxpr, which adds its operations to a builder.

    Args:
        builder: the program so far.
        compute_before: (equation, operands) ↦ the results of an operation without a formula here, or None.
    """

    def __init__(
        self, builder: Builder, compute_before: Callable[[JaxprEqn, list[np.ndarray]], list[np.ndarray] | None]
    ):
        self.builder, self._compute_before = builder, compute_before

    def jaxpr(self, closed: ClosedJaxpr | Jaxpr, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The results of a jaxpr, as arrays of numbers."""
        jaxpr: Any = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
        given = closed.consts if isinstance(closed, ClosedJaxpr) else []
        consts = [self.constant_array(x, var.aval.dtype) for x, var in zip(given, jaxpr.constvars, strict=True)]
        values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

        def read(atom: Any) -> Any:
            if isinstance(atom, Literal):
                return self.constant_array(atom.val, atom.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
            return values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
            if self.builder.length > _LONGEST:
                raise UnsupportedError(f"more than {_LONGEST} operations")
        return [read(x) for x in jaxpr.outvars]

    def constant_array(self, x: ArrayLike, dtype: DTypeLike) -> np.ndarray:
        """An array of constants."""
        if jax.numpy.issubdtype(dtype, jax.dtypes.prng_key):
            raise UnsupportedError("random keys")
        x = np.asarray(x, dtype)
        if x.size > _LARGEST:
            raise UnsupportedError(f"an array of {x.size} entries")
        return array_of([self.builder.constant(value) for value in x.flat], x.shape)

    def number(self, op: str, *inputs: Number, dtype: DTypeLike | None = None, data: object = None) -> Number:
        """The result of an operation on numbers."""
        return self.builder.number(op, *inputs, dtype=dtype, data=data)

    def _equation(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name, parameters = equation.primitive.name, equation.params
        out = shapes_of(equation.outvars)
        if any(np.prod(x.shape) > _LARGEST for x in out):
            raise UnsupportedError(f"an array of shape {out[0].shape}")
        if name in _STRUCTURE:
            return self._structure(name, inputs, parameters, out)
        if any(isinstance(x, Table) for x in inputs):
            if name in _CALLS:
                return self._call(parameters, inputs)
            if name in _CONTROL:
                return _CONTROL[name](self, inputs, parameters)
            return [self._look_up(name, inputs, parameters, out[0])]
        if name in _CALLS:
            return self._call(parameters, inputs)
        if name in _CONTROL:
            return _CONTROL[name](self, inputs, parameters)
        if name in _SPECIAL:
            return [_SPECIAL[name](self, inputs, parameters, out[0])]
        formula = _FORMULAS.get(name)
        if formula is None and name in _MACHINE:
            formula = functools.partial(_elementwise, op=_MACHINE[name])
        if formula is None:
            results = self._compute_before(equation, inputs)
            if results is None:
                raise UnsupportedError(name)
            return results
        arrays = np.broadcast_arrays(*inputs)
        dtype = np.dtype(out[0].dtype)
        entries = [formula(self, row, parameters, dtype) for row in zip(*(x.flat for x in arrays), strict=True)]
        return [array_of(entries, arrays[0].shape)]

    def _structure(
        self, name: str, inputs: list[np.ndarray], parameters: Parameters, out: list[ShapedArray]
    ) -> list[np.ndarray]:
        if any(isinstance(x, Table) for x in inputs):
            raise UnsupportedError(f"{name} of a long array")
        found = _STRUCTURE[name](*inputs, **parameters)
        return list(found) if name in ("split", "unstack") else [found]

    def _call(self, parameters: Parameters, inputs: list[np.ndarray]) -> list[np.ndarray]:
        inner = next(parameters[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call") if key in parameters)
        return self.jaxpr(inner, inputs)

    def _look_up(self, name: str, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
        """An entry of a table."""
        table = inputs[0]
        one = name == "dynamic_slice" or (name == "gather" and inputs[1].size == 1)
        if not (one and isinstance(table, Table) and np.prod(out.shape) == 1 and len(table.shape) == 1):
            raise UnsupportedError(f"{name} of a long array")
        mode = parameters["mode"].name if name == "gather" else "CLIP"
        [index], inside = _window(self, table.shape, (1,), list(inputs[1].flat), (0,), {}, mode)
        found = self.number("table", index, dtype=table.dtype, data=table.data)
        return array_of([found if name != "gather" else _fill(self, inside, found, parameters)], out.shape)

    def index(self, k: int) -> Number:
        """A constant index."""
        return self.builder.constant(k, np.int64)

    def clip_index(self, index: Number, last: int) -> Number:
        """An index from 0 to `last`, an int64."""
        index = self.number("convert", index, dtype=np.int64)
        return self.number("min", self.number("max", index, self.index(0)), self.index(last))

    def select(self, test: Number, on_true: Any, on_false: Any) -> Any:
        """Numbers or arrays, by a boolean."""
        if isinstance(on_true, Number):
            return self.number("select", test, on_true, on_false, dtype=on_true.dtype)
        pairs = zip(on_true.flat, on_false.flat, strict=True)
        return array_of([self.select(test, x, y) for x, y in pairs], on_true.shape)

    def loop_over_arrays(
        self,
        starts: list[np.ndarray],
        test: Callable[[list[np.ndarray]], Number],
        next_carry: Callable[[list[np.ndarray]], list[np.ndarray]],
    ) -> list[np.ndarray]:
        """A loop that carries arrays."""
        shapes = [x.shape for x in starts]

        def joined(numbers: list[Number]) -> list[np.ndarray]:
            left = iter(numbers)
            return [array_of([next(left) for _ in range(int(np.prod(shape)))], shape) for shape in shapes]

        def flat(arrays: list[np.ndarray]) -> list[Number]:
            return [x for array in arrays for x in array.flat]

        found = self.builder.loop(flat(starts), lambda c: test(joined(c)), lambda c: flat(next_carry(joined(c))))
        return joined(found)


# control


def _while(walk: Walk, inputs: list[np.ndarray], parameters: Parameters) -> list[np.ndarray]:
    n, m = parameters["cond_nconsts"], parameters["body_nconsts"]
    of_test, of_body, starts = inputs[:n], inputs[n : n + m], inputs[n + m :]

    def tests(carry: list[np.ndarray]) -> np.ndarray:
        return walk.jaxpr(parameters["cond_jaxpr"], [*of_test, *carry])[0]

    def test(carry: list[np.ndarray]) -> Number:
        return _sum(walk, "or", list(tests(carry).flat), np.dtype(bool))

    def next_carry(carry: list[np.ndarray]) -> list[np.ndarray]:
        after = walk.jaxpr(parameters["body_jaxpr"], [*of_body, *carry])
        which = tests(carry)
        return (
            after
            if not which.ndim
            else [_select_entries(walk, which, *pair) for pair in zip(after, carry, strict=True)]
        )

    return walk.loop_over_arrays(starts, test, next_carry)


def _select_entries(walk: Walk, which: np.ndarray, after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The values carried by a loop that has a test for each entry of the leading axes."""
    found = np.empty(after.shape, object)
    for index in np.ndindex(after.shape):
        test: Any = which[index[: which.ndim]]
        found[index] = walk.select(test, after[index], before[index])
    return found


def _scan(walk: Walk, inputs: list[np.ndarray], parameters: Parameters) -> list[np.ndarray]:
    length, closed = parameters["length"], parameters["jaxpr"]
    n, m = parameters["num_consts"], parameters["num_consts"] + parameters["num_carry"]
    consts, starts, series = inputs[:n], inputs[n:m], inputs[m:]
    order = range(length)[::-1] if parameters["reverse"] else range(length)
    stacked = len(closed.out_avals) > len(starts)
    if stacked or length <= _UNROLLED or length * _size(closed.jaxpr) <= _UNROLLED_NUMBERS:
        carry, rows = starts, []
        for k in order:
            found = walk.jaxpr(closed, [*consts, *carry, *(x[k] for x in map(_arrays, series))])
            carry = found[: len(starts)]
            rows.append(found[len(starts) :])
        if not stacked:
            return carry
        if not length:
            return [*carry, *(array_of([], (0, *x.shape)) for x in closed.out_avals[len(starts) :])]
        rows = rows[::-1] if parameters["reverse"] else rows
        return [*carry, *(_stack(*column, axis=0) for column in zip(*rows, strict=True))]
    zero, one, end = map(walk.index, (0, 1, length))

    def next_carry(carry: list[np.ndarray]) -> list[np.ndarray]:
        k = carry[0].item()
        at = walk.number("sub", walk.index(length - 1), k) if parameters["reverse"] else k
        rows = [_row(walk, x, at) for x in series]
        after = walk.jaxpr(closed, [*consts, *carry[1:], *rows])
        return [array_of([walk.number("add", k, one)], ()), *after]

    return walk.loop_over_arrays(
        [array_of([zero], ()), *starts], lambda c: walk.number("lt", c[0].item(), end), next_carry
    )[1:]


def _arrays(x: np.ndarray) -> np.ndarray:
    return x if x.ndim > 1 else array_of([array_of([y], ()) for y in x.flat], x.shape)


def _row(walk: Walk, x: np.ndarray | Table, k: Number) -> np.ndarray:
    """x[k] of an array of numbers at an index that the program computes."""
    if isinstance(x, Table):
        return array_of([walk.number("table", k, dtype=x.dtype, data=x.data)], ())
    columns = x.reshape(len(x), -1).T
    return array_of([_entry(walk, list(column), k) for column in columns], x.shape[1:])


def _entry(walk: Walk, column: list[Number], k: Number) -> Number:
    if all(x is column[0] for x in column):
        return column[0]
    if all(x.is_constant for x in column):
        values = np.array([x.data for x in column], column[0].dtype)
        return walk.number("values", k, dtype=values.dtype, data=(values.dtype.str, values.tobytes()))
    array = walk.number("array", *column, dtype=column[0].dtype)
    return walk.number("entry", k, array, dtype=column[0].dtype)


def _cond(walk: Walk, inputs: list[np.ndarray], parameters: Parameters) -> list[np.ndarray]:
    index, operands = inputs[0].item(), inputs[1:]
    return _branches(walk, index, parameters["branches"], operands)


def _branches(
    walk: Walk, index: Number, branches: Sequence[ClosedJaxpr], operands: list[np.ndarray]
) -> list[np.ndarray]:
    """The results of the branch of number `index`."""
    if len(branches) == 1:
        return walk.jaxpr(branches[0], operands)
    shapes = [x.shape for x in branches[0].out_avals]
    if index.dtype == bool:
        test = walk.number("not", index)
    else:
        test = walk.number("le", index, walk.builder.constant(0, index.dtype))
    rest = index if index.dtype == bool else walk.number("sub", index, walk.builder.constant(1, index.dtype))

    def first() -> list[Number]:
        return [x for array in walk.jaxpr(branches[0], operands) for x in array.flat]

    def others() -> list[Number]:
        return [x for array in _branches(walk, rest, branches[1:], operands) for x in array.flat]

    left = iter(walk.builder.branch(test, (first, others)))
    return [array_of([next(left) for _ in range(int(np.prod(shape)))], shape) for shape in shapes]


def _linear_solve(walk: Walk, inputs: list[np.ndarray], parameters: Parameters) -> list[np.ndarray]:
    lengths = parameters["const_lengths"]
    first = sum(lengths[:2])
    return walk.jaxpr(parameters["jaxprs"].solve, [*inputs[first : first + lengths.solve], *inputs[sum(lengths) :]])


def _size(jaxpr: Any) -> int:
    """About the number of operations of a jaxpr."""
    found = 0
    for equation in jaxpr.eqns:
        inner = [x for x in jax.tree.leaves(equation.params, is_leaf=_is_jaxpr) if _is_jaxpr(x)]
        repeats = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        found += sum(repeats * _size(getattr(x, "jaxpr", x)) for x in inner)
        if equation.primitive.name not in _STRUCTURE and not inner:
            found += sum(int(np.prod(x.aval.shape)) for x in equation.outvars)
    return found


def _is_jaxpr(x: object) -> bool:
    return isinstance(x, ClosedJaxpr | Jaxpr)


_CONTROL: dict[str, Callable[..., list[np.ndarray]]] = {
    "while": _while,
    "scan": _scan,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "optimization_barrier": lambda walk, inputs, parameters: inputs,
}
_CALLS = _names(
    "checkpoint closed_call core_call custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr custom_vmap_call jit pjit "
    "remat remat2"
)


# what moves entries


def _broadcast_in_dim(
    x: np.ndarray, *_: object, shape: Sequence[int], broadcast_dimensions: Sequence[int], **__: object
) -> np.ndarray:
    sizes = [1] * len(shape)
    for axis, n in zip(broadcast_dimensions, x.shape, strict=True):
        sizes[axis] = n
    return np.broadcast_to(x.reshape(sizes), shape)


def _slice(
    x: np.ndarray, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None
) -> np.ndarray:
    return x[tuple(itertools.starmap(slice, zip(start_indices, limit_indices, strides or (1,) * x.ndim, strict=True)))]


def _pad(x: np.ndarray, value: np.ndarray, padding_config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    shape = [lo + hi + max(n + (n - 1) * gap, 0) for n, (lo, hi, gap) in zip(x.shape, padding_config, strict=True)]
    found = array_of([value.item()] * int(np.prod(shape)), shape)
    for index in np.ndindex(x.shape):
        at = tuple(lo + k * (gap + 1) for k, (lo, _, gap) in zip(index, padding_config, strict=True))
        if all(0 <= k < n for k, n in zip(at, shape, strict=True)):
            found[at] = x[index]
    return found


def _stack(*arrays: np.ndarray, axis: int = 0, **_: object) -> np.ndarray:
    return np.concatenate([np.expand_dims(x, axis) for x in arrays], axis)


def _unstack(x: np.ndarray, axis: int, **_: object) -> list[np.ndarray]:
    return [array_of(list(y.flat), y.shape) for y in (x.take([k], axis).squeeze(axis) for k in range(x.shape[axis]))]


_STRUCTURE: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, dimensions),
    "pad": _pad,
    "reshape": lambda x, *_, new_sizes, **__: x.reshape(new_sizes),
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "stack": _stack,
    "tile": lambda x, reps: np.tile(x, reps),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "unstack": _unstack,
}


# arithmetic


def _elementwise(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype, op: str) -> Number:
    return walk.number(op, *x, dtype=dtype)


def _integer_power(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    exponent, base = parameters["y"], x[0]
    found, power = None, base
    for bit in reversed(bin(abs(exponent))[2:]):
        if bit == "1":
            found = power if found is None else walk.number("mul", found, power)
        power = walk.number("mul", power, power)
    one = walk.builder.constant(1, dtype)
    found = one if found is None else found
    return walk.number("div", one, found) if exponent < 0 else found


def _select(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    which, cases = x[0], x[1:]
    if which.dtype == bool:
        return walk.select(which, cases[1], cases[0]) if len(cases) > 1 else cases[0]
    found = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        found = walk.select(walk.number("eq", which, walk.builder.constant(k, which.dtype)), cases[k], found)
    return found


def _quotient(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype, op: str) -> Number:
    """A quotient or a remainder; that of integers by 0 and −1, where a CPU would trap, as XLA defines it."""
    if dtype.kind == "f":
        return walk.number(op, *x)
    a, b = x
    zero, one, ones = (walk.builder.constant(np.array(k).astype(dtype)) for k in (0, 1, -1))
    by_zero = walk.number("eq", b, zero)
    by_minus = walk.number("eq", b, ones) if dtype.kind == "i" else walk.builder.constant(False)
    found = walk.number(op, a, walk.select(walk.number("or", by_zero, by_minus), one, b))
    found = walk.select(by_minus, walk.number("neg", a) if op == "div" else zero, found)
    return walk.select(by_zero, ones if op == "div" else a, found)


def _shift(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype, op: str) -> Number:
    """A shift; for a shift by too many bits, or by a negative number, all bits are shifted out."""
    zero, last = (walk.builder.constant(k, dtype) for k in (0, 8 * dtype.itemsize - 1))
    inside = walk.number("and", walk.number("ge", x[1], zero), walk.number("le", x[1], last))
    found = walk.number(op, x[0], walk.select(inside, x[1], last))
    return found if op == "shift_right_arithmetic" else walk.select(inside, found, zero)


def _absolute(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    return x[0] if dtype.kind == "u" else walk.number("abs", x[0])


def _reduce_precision(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    info = np.finfo(dtype)
    if (parameters["exponent_bits"], parameters["mantissa_bits"]) != (info.nexp, info.nmant):
        raise UnsupportedError("reduce_precision")
    return x[0]


def _sign(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    if dtype.kind == "u":
        return walk.number("min", x[0], walk.builder.constant(1, dtype))
    zero, one, minus = (walk.builder.constant(k, dtype) for k in (0, 1, -1))
    below = walk.select(walk.number("lt", x[0], zero), minus, x[0])
    return walk.select(walk.number("gt", x[0], zero), one, below)


def _round(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    return walk.number("round_even" if int(parameters["rounding_method"]) else "round_away", x[0])


def _power(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    return walk.number("pow", x[0], walk.number("convert", x[1], dtype=dtype))


def _is_finite(walk: Walk, x: Sequence[Number], parameters: Parameters, dtype: np.dtype) -> Number:
    return walk.number("lt", walk.number("abs", x[0]), walk.builder.constant(np.inf, x[0].dtype))


_FORMULAS: dict[str, Callable[..., Number]] = {
    "abs": _absolute,
    "clamp": lambda walk, x, p, dtype: walk.number("min", walk.number("max", x[1], x[0]), x[2]),
    "copy": lambda walk, x, p, dtype: x[0],
    "copy_p": lambda walk, x, p, dtype: x[0],
    "div": functools.partial(_quotient, op="div"),
    "integer_pow": _integer_power,
    "is_finite": _is_finite,
    "name": lambda walk, x, p, dtype: x[0],
    "pow": _power,
    "reduce_precision": _reduce_precision,
    "rem": functools.partial(_quotient, op="rem"),
    "round": _round,
    "rsqrt": lambda walk, x, p, dtype: walk.number("div", walk.builder.constant(1, dtype), walk.number("sqrt", x[0])),
    "select_n": _select,
    "shift_left": functools.partial(_shift, op="shift_left"),
    "shift_right_arithmetic": functools.partial(_shift, op="shift_right_arithmetic"),
    "shift_right_logical": functools.partial(_shift, op="shift_right_logical"),
    "sign": _sign,
    "square": lambda walk, x, p, dtype: walk.number("mul", x[0], x[0]),
    "stop_gradient": lambda walk, x, p, dtype: x[0],
    "convert_element_type": lambda walk, x, p, dtype: walk.number("convert", x[0], dtype=dtype),
}
_SAME_NAMES = _names(
    "acos acosh add and asin asinh atan atan2 atanh cbrt ceil cos cosh eq exp exp2 expm1 floor ge gt le log log1p "
    "logistic lt max min mul ne neg not or sin sinh sqrt sub tan tanh xor"
)
_MACHINE = {"add_any": "add"} | {name: name for name in _SAME_NAMES}


# reductions, products, indices


def _reduction(op: str) -> Callable[..., np.ndarray]:
    def reduce(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
        x, axes = inputs[0], parameters["axes"]
        rest = [n for n in range(x.ndim) if n not in axes]
        rows = x.transpose(*rest, *axes).reshape(int(np.prod(out.shape)), int(np.prod([x.shape[n] for n in axes])))
        return array_of([_sum(walk, op, list(row), np.dtype(out.dtype)) for row in rows], out.shape)

    return reduce


def _empty_reduction(op: str, dtype: np.dtype) -> Any:
    """The result of a reduction of no terms."""
    if op in ("max", "min"):
        ends = (-np.inf, np.inf) if dtype.kind == "f" else (False, True)
        low, high = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else ends
        return low if op == "max" else high
    return {"add": 0, "mul": 1, "and": np.array(-1).astype(dtype), "or": 0, "xor": 0}[op]


def _sum(walk: Walk, op: str, terms: list[Number], dtype: np.dtype) -> Number:
    if not terms:
        return walk.builder.constant(_empty_reduction(op, dtype), dtype)
    return functools.reduce(lambda x, y: walk.number(op, x, y), terms)


def _cumulative(op: str) -> Callable[..., np.ndarray]:
    def cumulate(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
        x = np.moveaxis(inputs[0], parameters["axis"], 0)
        found = np.empty(x.shape, object)
        order = range(len(x))[::-1] if parameters["reverse"] else range(len(x))
        for index in np.ndindex(x.shape[1:]):
            total = None
            for k in order:
                term = x[k, *index]
                total = found[k, *index] = term if total is None else walk.number(op, total, term)
        return np.moveaxis(found, 0, parameters["axis"])

    return cumulate


def _product(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
    a, b = inputs
    (a_sum, b_sum), (a_each, b_each) = parameters["dimension_numbers"]
    left, right = _as_matrices(a, a_each, a_sum), _as_matrices(b, b_each, b_sum)
    dtype = np.dtype(out.dtype)

    def as_result(x: Number) -> Number:
        return walk.number("convert", x, dtype=dtype)

    entries = [
        _sum(
            walk,
            "add",
            [walk.number("mul", as_result(x), as_result(y)) for x, y in zip(row, column, strict=True)],
            dtype,
        )
        for rows, columns in zip(left, right, strict=True)
        for row in rows
        for column in columns
    ]
    return array_of(entries, out.shape)


def _as_matrices(x: np.ndarray, each: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """The axes of a factor as (those of both, its own, those to sum over)."""
    own = [n for n in range(x.ndim) if n not in (*each, *summed)]
    sizes = [int(np.prod([x.shape[n] for n in axes])) for axes in (each, own, summed)]
    return x.transpose(*each, *own, *summed).reshape(sizes)


def _iota(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
    n = out.shape[parameters["dimension"]]
    sizes = [n if k == parameters["dimension"] else 1 for k in range(len(out.shape))]
    return walk.constant_array(np.broadcast_to(np.arange(n).reshape(sizes), out.shape), out.dtype)


def _extreme(by: str) -> Callable[..., np.ndarray]:
    def index_of(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
        [axis] = parameters["axes"]
        rows = np.moveaxis(inputs[0], axis, -1).reshape(-1, inputs[0].shape[axis])
        found = []
        for row in rows:
            best, at = row[0], walk.builder.constant(0, out.dtype)
            for k in range(1, len(row)):
                better = walk.number("or", walk.number(by, row[k], best), _first_nan(walk, row[k], best))
                at = walk.select(better, walk.builder.constant(k, out.dtype), at)
                best = walk.select(better, row[k], best)
            found.append(at)
        return array_of(found, out.shape)

    return index_of


def _first_nan(walk: Walk, x: Number, before: Number) -> Number:
    """Whether x is NaN, and the number before is not."""
    if x.dtype.kind != "f":
        return walk.builder.constant(False)
    return walk.number("and", walk.number("ne", x, x), walk.number("eq", before, before))


def _entry_at(walk: Walk, x: np.ndarray, index: Sequence[Number]) -> Number:
    """x[index], where each index is in bounds, and may be a number that the program computes."""
    if not len(index):
        return x.item()
    k, rest = index[0], index[1:]
    if k.is_constant:
        return _entry_at(walk, x[int(k.data)], rest) if len(rest) else x[int(k.data)]
    found = [_entry_at(walk, x[n], rest) if len(rest) else x[n] for n in range(len(x))]
    if len(found) > _SELECTED:
        return _entry(walk, found, k)
    chosen = found[0]
    for n in range(1, len(found)):
        chosen = walk.select(walk.number("eq", k, walk.builder.constant(n, k.dtype)), found[n], chosen)
    return chosen


def _offset(walk: Walk, start: Number, offset: int) -> Number:
    return walk.number("add", start, walk.index(offset))


def _dynamic_slice(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
    x, sizes = inputs[0], parameters["slice_sizes"]
    starts = [walk.clip_index(k.item(), n - m) for k, n, m in zip(inputs[1:], x.shape, sizes, strict=True)]
    found = np.empty(sizes, object)
    for index in np.ndindex(*sizes):
        found[index] = _entry_at(walk, x, [_offset(walk, s, k) for s, k in zip(starts, index, strict=True)])
    return found


def _dynamic_update_slice(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
    x, update = inputs[:2]
    pairs = zip(inputs[2:], x.shape, update.shape, strict=True)
    starts = [walk.clip_index(k.item(), n - m) for k, n, m in pairs]
    return _write_windows(walk, x, [(starts, walk.builder.constant(True), update)], lambda old, new: new)


def _write_windows(
    walk: Walk, x: np.ndarray, updates: Sequence[Window], combine: Callable[[Number, Number], Number]
) -> np.ndarray:
    """x with windows (their first index, whether they are written, their numbers) written into it."""
    found = np.array(x, object)
    for starts, inside, update in updates:
        for index in np.ndindex(update.shape):
            at = [_offset(walk, s, k) for s, k in zip(starts, index, strict=True)]
            for place in np.ndindex(x.shape):
                same = [walk.number("eq", k, walk.builder.constant(n, k.dtype)) for k, n in zip(at, place, strict=True)]
                here = _sum(walk, "and", [*same, inside], np.dtype(bool))
                before, new = found[place], update[index]
                found[place] = walk.select(here, combine(before, new), before)  # pyright: ignore[reportArgumentType]
    return found


Window = tuple[list[Number], Number, np.ndarray]  # its first index, whether it is written, its numbers


def _window(
    walk: Walk,
    shape: Sequence[int],
    sizes: Sequence[int],
    index: Sequence[Number],
    axes: Sequence[int],
    batch: dict[int, int],
    mode: str,
) -> tuple[list[Number], Number]:
    """The first index of a window of an array, moved inside, and whether it was inside before (or counts as inside).

    Args:
        walk: the walk.
        shape, sizes: of the array, and of the window.
        index, axes: numbers, and the axes that they are indices of.
        batch: the indices of other axes, which are known.
        mode: the name of a `jax.lax.GatherScatterMode`.
    """
    if mode not in ("CLIP", "FILL_OR_DROP", "PROMISE_IN_BOUNDS"):
        raise UnsupportedError(f"indices of mode {mode}")
    starts, inside = [walk.index(batch.get(n, 0)) for n in range(len(shape))], walk.builder.constant(True)
    for n, k in zip(axes, index, strict=True):
        starts[n] = walk.clip_index(k, shape[n] - sizes[n])
        if mode == "FILL_OR_DROP":
            same = walk.number("eq", walk.number("convert", k, dtype=np.int64), starts[n])
            inside = walk.number("and", inside, same)
    return starts, inside


def _fill(walk: Walk, inside: Number, found: Number, parameters: Parameters) -> Number:
    """The entry of a gather if it is inside, else the fill value."""
    value, dtype = parameters["fill_value"], found.dtype
    if value is None:
        value = {"f": np.nan, "b": True}.get(dtype.kind)
    if value is None:
        value = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return walk.select(inside, found, walk.builder.constant(value, dtype))


def _gather(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
    x, indices = inputs
    numbers, sizes, mode = parameters["dimension_numbers"], parameters["slice_sizes"], parameters["mode"].name
    offset_dims, batching = numbers.offset_dims, numbers.operand_batching_dims
    window_axes = [n for n in range(x.ndim) if n not in (*numbers.collapsed_slice_dims, *batching)]
    found = np.empty(out.shape, object)
    for place in np.ndindex(out.shape):
        batch = [k for n, k in enumerate(place) if n not in offset_dims]
        known = {n: batch[m] for n, m in zip(batching, numbers.start_indices_batching_dims, strict=True)}
        index = list(indices[tuple(batch)])
        at, inside = _window(walk, x.shape, sizes, index, numbers.start_index_map, known, mode)
        for n, m in zip(window_axes, offset_dims, strict=True):
            at[n] = _offset(walk, at[n], place[m])
        found[place] = _fill(walk, inside, _entry_at(walk, x, at), parameters)
    return found


def _scatter(combine: str | None) -> Callable[..., np.ndarray]:
    def scatter(walk: Walk, inputs: list[np.ndarray], parameters: Parameters, out: ShapedArray) -> np.ndarray:
        x, indices, updates = inputs
        numbers, mode = parameters["dimension_numbers"], parameters["mode"].name
        batching, axes = numbers.operand_batching_dims, numbers.scatter_dims_to_operand_dims
        batch_axes = [n for n in range(updates.ndim) if n not in numbers.update_window_dims]
        single = sorted((*numbers.inserted_window_dims, *batching))
        windows = []
        for batch in np.ndindex(*(updates.shape[n] for n in batch_axes)):
            chosen: list[Any] = [slice(None)] * updates.ndim
            for n, k in zip(batch_axes, batch, strict=True):
                chosen[n] = k
            part = np.expand_dims(updates[tuple(chosen)], tuple(single))
            known = {n: batch[m] for n, m in zip(batching, numbers.scatter_indices_batching_dims, strict=True)}
            windows.append((*_window(walk, x.shape, part.shape, list(indices[batch]), axes, known, mode), part))
        return _write_windows(walk, x, windows, lambda a, b: b if combine is None else walk.number(combine, a, b))

    return scatter


_SPECIAL: dict[str, Callable[..., np.ndarray]] = {
    "argmax": _extreme("gt"),
    "argmin": _extreme("lt"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
    "cumprod": _cumulative("mul"),
    "cumsum": _cumulative("add"),
    "dot_general": _product,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "iota": _iota,
    "reduce_and": _reduction("and"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_or": _reduction("or"),
    "reduce_prod": _reduction("mul"),
    "reduce_sum": _reduction("add"),
    "reduce_xor": _reduction("xor"),
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "scatter-max": _scatter("max"),
    "scatter-min": _scatter("min"),
    "scatter-mul": _scatter("mul"),
}
