"""Programs of numbers against JAX: each primitive, loops, branches and indices, for members that differ."""

import itertools
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

pytest.importorskip("llvmlite")

from kernels import Kernel, MachineFunction
from native_members import MEMBERS, bits, by_jax, check_against_jax, compiled, stacking

import lieint_jax as li
from lieint_jax import schemes, systems
from lieint_jax.native import _machine, _pieces
from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._primitives.control_flow import CONTROL_FLOW
from lieint_jax.native._primitives.elementwise import ELEMENTWISE
from lieint_jax.runs import _engine

pytestmark = pytest.mark.long

SPECIAL = [0.0, -0.0, np.inf, -np.inf, np.nan, 1.5, -2.5]  # XLA takes subnormal numbers for 0
TYPES = [np.int32, np.int64, np.uint32, np.uint8, np.int8, np.uint64, np.int16, np.uint16]


def normal(*shape, seed=0, dtype=np.float64):
    return np.random.default_rng(seed).normal(size=(MEMBERS, *shape)).astype(dtype)


def pairs(values, dtype):
    """All pairs of some values, one for each member."""
    array = np.array(list(itertools.product(values, values)), dtype)
    return array[:, 0], array[:, 1]


def single(names, count):
    """The functions of `jax.lax` of these names, of `count` arguments, in one program."""
    return lambda *x: {name: getattr(lax, name)(*x[:count]) for name in names.split()}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_real_arithmetic_has_the_bits_of_jax(dtype):
    """Signed zeros, infinities and NaN too."""

    def function(x, y):
        found = single("add sub mul div rem eq ne lt le gt ge", 2)(x, y)
        found |= single("neg abs sign floor ceil sqrt is_finite square", 1)(x)
        found |= {"round": lax.round(x), "even": lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)}
        found |= {f"to {t.__name__}": x.astype(t) for t in TYPES} | {"to bool": x.astype(bool)}
        found |= {"to f4": x.astype(np.float32), "to f8": x.astype(np.float64)}
        return found | {"select": jnp.where(x < y, x, y), "power": lax.integer_pow(x, 3)}

    check_against_jax(function, pairs([*SPECIAL, 300.7, -3e10, 1e20], dtype), signs=True)


@pytest.mark.quick
def test_greatest_and_least_show_nan():
    def function(x, y):
        return lax.max(x, y), lax.min(x, y), lax.clamp(-1.0, x, 2.0), lax.clamp(x, y, x + 1)

    check_against_jax(function, pairs(SPECIAL, np.float64))


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 4e-15), (np.float32, 2e-6)])
def test_elementary_functions_have_the_names_types_and_arguments_of_jax(dtype, rtol):
    """Their errors in ulp are measured elsewhere; here their names, types and arguments."""

    def function(x, y):
        found = single("sin cos tan atan sinh cosh tanh asinh exp exp2 expm1 cbrt logistic", 1)(x)
        found |= single("log log1p sqrt rsqrt", 1)(y) | single("asin acos atanh", 1)(jnp.tanh(x / 2))
        return found | {
            "atan2": lax.atan2(x, y),
            "acosh": lax.acosh(1.5 + y),
            "power": lax.pow(y, x),
            "whole": lax.pow(x, jnp.int32(3)),
            "inverse": lax.integer_pow(x, -3),
            "zeroth": lax.integer_pow(x, 0),
        }

    check_against_jax(function, (normal(dtype=dtype), np.abs(normal(seed=1, dtype=dtype))), rtol=rtol)


def test_derivatives_of_elementary_functions_are_programs_of_numbers():
    """First and second ones: releases of JAX write them with primitives of different names."""
    names = {
        "any": "sin cos tan atan sinh cosh tanh asinh exp exp2 expm1 cbrt logistic square",
        "positive": "log log1p log2 sqrt rsqrt reciprocal",
        "below one": "asin acos atanh",
        "above one": "acosh",
    }

    def function(x, y):
        places = {"any": x, "positive": y, "below one": jnp.tanh(x / 2), "above one": 1.5 + y}
        found = {}
        for kind, words in names.items():
            for name in words.split():
                f = getattr(lax, name, None) or getattr(jnp, name)
                found[name] = [g(places[kind]) for g in (f, jax.grad(f), jax.grad(jax.grad(f)))]
        if hasattr(lax, "polynomial"):  # JAX ≥ 0.12
            found["polynomial"] = [lax.polynomial(y, c) for c in ([1.0, 2.0, 3.0], [x, y, x, y])]
        return found

    check_against_jax(function, (normal(), np.abs(normal(seed=1))), rtol=1e-13)


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("dtype", TYPES)
def test_integers_wrap_and_divide_as_in_xla(dtype):
    """They wrap, and their quotients by 0 and −1 and shifts by any number of bits are XLA's, and stop no machine."""
    info = np.iinfo(dtype)

    def function(x, y):
        names = "add sub mul div rem eq ne lt le gt ge max min and_or"
        found = single(names.removesuffix(" and_or"), 2)(x, y)
        found |= {"and": x & y, "or": x | y, "xor": x ^ y, "not": ~x, "power": lax.integer_pow(x, 3)}
        found |= single("shift_left shift_right_logical shift_right_arithmetic", 2)(x, y)
        found |= {"sign": lax.sign(x), "abs": abs(x), "clamp": lax.clamp(dtype(3), x, dtype(9))}
        found |= {"by 0": lax.div(x, dtype(0)), "by 7": lax.rem(x, dtype(7)), "shift": lax.shift_left(x, dtype(3))}
        found |= {f"to {t.__name__}": x.astype(t) for t in [*TYPES, np.float64, np.float32, bool]}
        return found | ({"neg": -x} if info.min else {})

    check_against_jax(function, pairs([info.min, info.max, 0, 1, 3, 7, 40, info.max - 1, info.max // 2 + 1], dtype))


@pytest.mark.quick
def test_booleans_have_the_values_of_jax():
    def function(x, y):
        found = single("eq ne lt le gt ge max min", 2)(x, y)
        found |= {"and": x & y, "or": x | y, "xor": x ^ y, "not": ~x, "known": x & True}
        found |= {f"to {t.__name__}": x.astype(t) for t in [*TYPES, np.float64, np.float32]}
        return found | {"all": (x | ~y).all(), "sum": jnp.stack([x, y]).sum(), "select": jnp.where(x, y, ~y)}

    check_against_jax(function, pairs([True, False], bool))


def test_indexing_and_stacking_move_entries():
    def function(x):
        y = x[:, :2]
        return {
            "transpose": x.T,
            "reshape": x.reshape(2, 2, 3),
            "broadcast": jnp.broadcast_to(x[:, None, :], (4, 2, 3)),
            "slice": x[1:4:2, ::2],
            "rev": x[::-1],
            "pad": lax.pad(y, 7.0, ((1, 2, 1), (-1, 0, 0))),
            "cut": lax.pad(y, x[0, 0], ((-2, -1, 2), (0, 1, 3))),
            "concatenate": jnp.concatenate([x, y], 1),
            "stack": jnp.stack([x, 2 * x], 1),
            "split": jnp.split(x, 3, axis=1),
            "unstack": jnp.unstack(x, axis=1),
            "tile": jnp.tile(y, (2, 1)),
            "iota": lax.broadcasted_iota(np.int32, (2, 3), 1),
            "which": lax.select_n(jnp.array([0, 2, 1]), x[0], x[1], x[2]),
            "chosen": lax.select_n((x[0] > 0).astype(np.int32) + (x[1] > 0), x[0], x[1], x[2]),
            "nothing": x[:0],
        }

    check_against_jax(function, [normal(4, 3)])


def test_reductions_and_products_are_those_of_jax():
    whole = np.random.default_rng(1).integers(-9, 9, (MEMBERS, 3, 4))
    with_nan = normal(3, 4)
    with_nan[::3, 1, 2] = with_nan[1::3, 0, 1] = with_nan[::2, 2, 0] = np.nan

    def reduced(x):
        return {"sum": x.sum(1), "prod": x.prod(0), "max": x.max(), "min": x.min(0)} | {
            "argmax": x.argmax(1),
            "argmin": lax.argmin(x, 0, np.int32),
            "cumsum": lax.cumsum(x, 1),
            "reverse": lax.cumsum(x, 0, reverse=True),
            "cumprod": lax.cumprod(x, 0),
            "cummax": lax.cummax(x, 1),
            "cummin": lax.cummin(x, 1, reverse=True),
        }

    def of_nothing(x):
        y = x[:, :0]
        found = {"sum": y.sum(1), "prod": y.prod(), "max": lax.reduce_max(y, (1,)), "min": lax.reduce_min(y, (1,))}
        return found | {"nothing": y.sum(0)}

    def function(x, k, nan):
        found = {"real": reduced(x), "whole": reduced(k), "nan": reduced(nan)}
        found |= {"no real": of_nothing(x), "no whole": of_nothing(k), "no truth": of_nothing(k > 0)["max"]}
        found |= {"and": lax.reduce_and(k, (0,)), "or": lax.reduce_or(k, (1,)), "xor": lax.reduce_xor(k, (1,))}
        found |= {"no and": lax.reduce_and(k[:0], (0,)), "truth": lax.reduce_xor(k > 0, (0,))}
        found |= {
            "outer": jnp.einsum("ij,kj->ik", x, x),
            "batch": jnp.einsum("ij,ijk->ik", x, x[..., None] * x[:, None]),
        }
        found |= {"mixed": lax.dot(k, k.T, preferred_element_type=np.float64), "dot": x[0] @ x[1], "k": k @ k.T}
        return found | {"zeros": jnp.zeros((2, 3)) @ x, "identity": jnp.eye(3) @ x}

    check_against_jax(function, (normal(3, 4), whole, with_nan), rtol=1e-13, atol=1e-14)


MODES = ["clip", "fill", "promise_in_bounds"]


@pytest.mark.parametrize("dtype", [np.float64, np.int32, np.uint32, np.bool_])
@pytest.mark.parametrize("mode", MODES)
def test_indices_of_any_kind_are_those_of_jax(mode, dtype):
    """Known and computed ones, of a member and shared, in bounds and out of them."""
    x = (10 * normal(4, 3)).astype(dtype)
    long = (10 * normal(12, seed=2)).astype(dtype)
    k = np.random.default_rng(3).integers(-9, 9, (MEMBERS, 2), np.int32)
    inside = np.abs(k) % 3
    update = (10 * normal(2, 2, seed=4)).astype(dtype)

    def indexed(index, x, long, update):
        fills = {"fill_value": 1} if mode == "fill" else {}
        inside_only = mode == "promise_in_bounds"  # then a window of 2 × 2 must fit: else JAX may do anything
        found = {
            "row": x.at[index[0]].get(mode=mode),
            "rows": x.at[index].get(mode=mode),
            "entry": x.at[index[0], index[1]].get(mode=mode, **fills),
            "column": x.at[:, index].get(mode=mode),
            "long": long.at[index].get(mode=mode),
            "set": x.at[index[0]].set(update[0, 0], mode=mode),
            "entries": x.at[index, index[::-1]].set(update[0], mode=mode),
            "window": lax.scatter(x, index % 2 if inside_only else index, update, _WINDOW, mode=mode),
            "many": jax.vmap(lambda row, k: row.at[k].get(mode=mode))(x[:2], index),
            "some": jax.vmap(lambda row, k, u: row.at[k].set(u, mode=mode))(x[:2], index, update[0]),
        }
        if dtype != np.bool_:
            found["add"] = x.at[index, 1].add(update[1], mode=mode)
            found["mul"] = x.at[index, 1].multiply(update[1], mode=mode)
            found["max"] = x.at[index, 1].max(update[1], mode=mode)
            found["min"] = x.at[index, 1].min(update[1], mode=mode)
        return found

    def function(x, long, k, inside, update, shared):
        promised = mode == "promise_in_bounds"
        known = np.array([1, 2] if promised else [-11, 3])
        computed, common = (inside, shared % 3) if promised else (k, shared)
        return [indexed(index, x, long, update) for index in (known, computed, common)]

    check_against_jax(function, (x, long, k, inside, update), [np.array([2, 7])], rtol=1e-15)


@pytest.mark.parametrize("dtype", [np.float64, np.bool_])
def test_slices_at_computed_indices_are_those_of_jax(dtype):
    def function(x, update, k, shared):
        return [
            {
                "slice": lax.dynamic_slice(x, (i[0], i[1]), (2, 2)),
                "update": lax.dynamic_update_slice(x, update, (i[0], i[1])),
                "one": lax.dynamic_index_in_dim(x, i[1], keepdims=False),
                "entry": x[i[0], 1],
                "of many": x.ravel()[i[0]],
            }
            for i in (np.array([9, -9]), k, shared)
        ]

    k = np.random.default_rng(3).integers(-9, 9, (MEMBERS, 2), np.int32)
    member = (10 * normal(4, 3)).astype(dtype), (10 * normal(2, 2, seed=4)).astype(dtype), k
    check_against_jax(function, member, [np.array([2, 7])])


_WINDOW = lax.ScatterDimensionNumbers((0, 1), (), (0, 1))


def test_loops_of_a_known_length_are_those_of_jax():
    """Written out and rolled, forwards and backwards, over what is known, shared, and a member's, with results."""
    series = jnp.array(np.random.default_rng(5).normal(size=(200, 2)))

    def loop(known, shared, own, flags, x, length, reverse):
        def stage(carry, row):
            a, n, flag = carry
            known, shared, own, on = row
            a = jnp.where(flag ^ on, 0.9 * a + known * shared, a - 0.3 * own)
            return (a, n + 1, ~flag), a.sum()

        xs = (known[:length], shared[:length], own[:length], flags[:length])
        after, sums = lax.scan(stage, (x, 0, True), xs, reverse=reverse)
        rolled, _ = lax.scan(lambda c, row: (stage(c, row)[0], None), (x, 0, True), xs, reverse=reverse)
        return rolled if length > 9 else (after, sums, rolled)

    def function(own, flags, x, shared):
        found = {
            f"{length} {reverse}": loop(series, shared, own, flags, x, length, reverse)
            for length in (0, 3, 30)
            for reverse in (False, True)
        }
        long = lax.scan(lambda c, row: (c + row * c.sum() * 1e-3, None), x, series)[0]
        few = lax.scan(lambda c, row: (c + row, c > 0), x, own, length=30)
        same = lax.scan(lambda c, row: (c + row, None), x[0], jnp.full(150, 0.5))[0]
        power = lax.fori_loop(0, 300, lambda n, c: c * 1.001 + series[n % 200], x)
        return found | {"long": long, "few": few, "same": same, "power": power}

    flags = np.random.default_rng(6).integers(0, 2, (MEMBERS, 30)).astype(bool)
    check_against_jax(function, (normal(30, 2), flags, normal(2, seed=1)), [series[::-1].copy()[:30]], rtol=1e-12)


def test_rows_that_a_step_writes_and_reads_are_those_of_jax():
    k = np.random.default_rng(3).integers(0, 20, MEMBERS)
    weights = normal(20, 2)[0] + 0.5
    check_against_jax(lambda x, k, w: stacking(x, w, k), [normal(2), k], [weights], rtol=1e-12, atol=1e-13)
    examples = np.zeros(2), weights, np.asarray(3)
    made = Kernel(stacking, ("member", "shared", "shared"), examples)
    assert made.length < 1400  # 1083; 1850 with each iteration by itself


def test_loops_of_an_unknown_length_are_those_of_jax():
    """As long as a shared number says, or a member's; nested, in a map over entries, with all kinds of carries."""

    def halved(x):
        return lax.while_loop(lambda c: c[0] > 1e-3, lambda c: (c[0] / 2, c[1] + 1, ~c[2], c[0]), (x, 0, True, 0.0))

    def nested(x):
        def outer(c):
            inner = lax.while_loop(lambda d: d[0] < c[0], lambda d: (d[0] * 1.5, d[1] + 1), (0.01, c[1]))
            return c[0] / 3, inner[1]

        return lax.while_loop(lambda c: c[0] > 0.05, outer, (x, jnp.uint32(0)))

    def counted(x, n):
        """A loop over the steps whose body has a loop with an end of its own, and a branch of either kind."""

        def body(k, x):
            x = lax.cond(k % 2 == 0, lambda x: halved(x)[0] + x, lambda x: x + series[k % 3], x)
            return lax.cond(x > 1, lambda x: x - lax.fori_loop(0, k % 4, lambda _, y: y / 2, x), jnp.sin, x)

        return lax.fori_loop(0, n, body, x)

    series = jnp.array([0.1, -0.4, 0.7])

    def function(x, k, n):
        return {
            "while": halved(x[0]),
            "map": jax.vmap(halved)(x),
            "map of two": jax.vmap(jax.vmap(halved))(x.reshape(1, 2)),
            "nested": nested(x[1]),
            "map of nested": jax.vmap(nested)(x),
            "shared": counted(x[0], n),
            "own": counted(x[1], k),
            "never": lax.while_loop(lambda c: False, lambda c: c + 1, x),
            "no pass": lax.fori_loop(n, n, lambda _, c: c + 1, x),
            "fixed": lax.while_loop(lambda c: c[1] < n, lambda c: (c[0], c[1] + 1), (x[0], n - 2)),
            "none": jax.vmap(halved)(x[:0]),
        }

    x = np.abs(normal(2))
    x[3] = np.nan
    x[5] = 0
    k = np.random.default_rng(1).integers(0, 9, MEMBERS)
    check_against_jax(function, (x, k), [np.int64(7)], rtol=1e-13)


def test_branches_are_those_of_lax_cond():
    def function(x, k, flag, n, on):
        def sides(test):
            return lax.cond(test, lambda: (x[0] * 2, n, x > 0, 1.0, n), lambda: (x[1], 3, x < 9, n * 1.0, 4))

        def among(k):
            return lax.switch(k, [lambda x: x, jnp.cos, lambda x: jnp.zeros_like(x), lambda x: x * x], x)

        return {
            "own": sides(flag),
            "shared": sides(on),
            "known": sides(True),
            "among": among(k),
            "shared among": among(n),
            "outside": (among(-3), among(9)),
            "of a number": lax.cond(x[0] > 0, lambda: lax.fori_loop(0, k, lambda _, y: y + 1, x[0]), lambda: x[1]),
            "map": jax.vmap(lambda y: lax.cond(y > 0, jnp.sqrt, lambda y: -y, y))(x),
        }

    k = np.arange(MEMBERS) % 7 - 2
    flag = np.arange(MEMBERS) % 3 == 0
    for n, on in ((2, True), (0, False)):
        check_against_jax(function, (normal(2), k, flag), [np.int64(n), np.bool_(on)], rtol=1e-14)


def test_solves_and_calls_are_those_of_jax():
    def function(x):
        root = lax.custom_root(
            lambda y: y**3 + y - x[0],
            0.0,
            lambda f, y: lax.fori_loop(0, 30, lambda _, y: y - f(y) / (3 * y**2 + 1), y),
            lambda g, y: y / g(1.0),
        )
        solved = lax.custom_linear_solve(lambda v: 3 * v * (1 + x**2), x, lambda _, b: b / (3 * (1 + x**2)))
        return {
            "root": root,
            "solved": solved,
            "jit": jax.jit(jnp.tanh)(x),
            "checkpoint": jax.checkpoint(jnp.sin)(x),
            "slope": jax.grad(lambda x: jax.nn.softplus(x).sum() + root)(x),
            "barrier": lax.optimization_barrier(x),
            "stop": lax.stop_gradient(x),
            "precision": lax.reduce_precision(x, 11, 52),
        }

    check_against_jax(function, [normal(3)], rtol=1e-13)


@pytest.mark.parametrize(("dtype", "error"), [(np.float64, 4e-15), (np.float32, 1e-6)])
def test_linear_algebra_and_sorts_are_those_of_jax(dtype, error):
    """By LAPACK there. Matrices need pivots, or have some of equal size; several at once. NaN stays NaN.

    Observed: 9e-16 and 2.4e-7.
    """
    A = (normal(2, 4, 4, seed=1) / 2 + 3 * np.eye(4)[[2, 0, 3, 1]]).astype(dtype)
    A[2, 0] = np.eye(4)[::-1]
    b = normal(2, 4, seed=2, dtype=dtype)
    b[3, 0, 1], b[4, 0, 1] = np.nan, b[4, 0, 0]

    def one(A, b):
        P = A @ A.T
        found = {"L": jnp.linalg.cholesky(P), "no L": jnp.linalg.cholesky(-P), "det": jnp.linalg.det(A / 3)}
        found |= {"inverse": jnp.linalg.inv(A), "transposed": jnp.linalg.solve(A.T, b)}
        found |= {"slope": jax.grad(lambda A: jnp.linalg.solve(A, b) @ b)(A)}
        right = lax.linalg.triangular_solve(A + 6 * np.eye(4, dtype=dtype), A, left_side=False, lower=True)
        return found | {"from the right": right, "sorted": jnp.sort(b), "order": jnp.argsort(-b)}

    check_against_jax(jax.vmap(one), [A, b], atol=error)
    A[0, 0, 1, 1], A[1, 0, 2] = np.nan, 0.0  # of these LAPACK, by its own order, may find other numbers finite
    inverse, det = compiled(lambda A: (jnp.linalg.inv(A), jnp.linalg.det(A)), [A[:, 0]])([A[:, 0]])
    np.testing.assert_array_equal(np.isfinite(inverse).all((1, 2)), [False, False, *[True] * (len(A) - 2)])
    np.testing.assert_array_equal([np.isnan(det[0]), det[1]], [True, 0.0])
    with pytest.raises(UnsupportedError, match="of shape \\(13,\\)"):
        compiled(jnp.sort, [normal(13)])


READ = {  # the parameters of control flow that the walk reads: releases of JAX differ in the others
    "scan": {"jaxpr", "length", "reverse"},
    "while": {"cond_jaxpr", "body_jaxpr"},
    "cond": {"branches"},
    "custom_linear_solve": {"jaxprs"},
}


@pytest.mark.quick
def test_constants_carries_and_rows_are_recognized_by_number_and_shape(monkeypatch):
    def read_only(handler, names):
        return lambda walk, inputs, parameters, out: handler(walk, inputs, {k: parameters[k] for k in names}, out)

    for name, names in READ.items():
        monkeypatch.setitem(CONTROL_FLOW, name, read_only(CONTROL_FLOW[name], names))

    def function(x, k, scale):
        def step(carry, row):
            y, total = carry
            return (y * scale + row.sum(), total + x), y.sum() + row[0]

        rows = jnp.outer(jnp.arange(6.0), x)
        inverse = 1 / scale  # the constant of each function is another one
        solved = lax.custom_linear_solve(lambda v: scale * v, x, lambda _, b: inverse * b, lambda _, b: b / scale)
        return {
            "scan": lax.scan(step, (x, x), rows),
            "no carry": lax.scan(lambda _, row: (None, row * scale), None, rows)[1],
            "no rows": lax.scan(lambda y, _: (y * scale + x, None), x, None, 6)[0],
            "while": lax.while_loop(lambda c: c[1] < k, lambda c: (c[0] * scale + x, c[1] + 1), (x, 0)),
            "nothing": lax.while_loop(lambda _: False, lambda _: (), ()),
            "cond": lax.cond(k > 2, lambda y: y + x, lambda y: y * scale, x),
            "solved": solved,
        }

    check_against_jax(function, [normal(3), np.arange(MEMBERS)], [1.5], rtol=1e-13)


@pytest.mark.parametrize("broken", [(CONTROL_FLOW, "while"), (ELEMENTWISE, "mul"), (_pieces, "Writer")])
def test_any_failure_of_an_engine_means_xla_and_is_logged_once(monkeypatch, caplog, broken):
    """A failure of the walk or of what writes LLVM's text, as by a primitive that a later JAX has changed."""

    def fail(*_, **__):
        raise KeyError(name)

    def potential(axis):  # of this test alone, so that no engine of it is in the cache
        return axis @ jnp.array([0.1, 0.2, 0.3])

    place, name = broken
    top = systems.potential_top([1.0, 2.0, 3.0], potential)
    step, states = schemes.top_energy_momentum(top), jax.vmap(lambda w: top.state(angular_velocity=w))(normal(3))
    expected = jax.jit(jax.vmap(lambda z: step(z, 0.1)[0]))(states)
    with monkeypatch.context() as patch:
        patch.setitem(place, name, fail) if isinstance(place, dict) else patch.setattr(place, name, fail)
        runs = [li.run(step, states, 0.1, n, progress=False, save_every=None).trajectory for n in (1, 2)]
    assert runs[0].info.converged.all()
    np.testing.assert_allclose(runs[0].state.p[-1], expected.p, rtol=1e-14)
    [message] = [record.getMessage() for record in caplog.records if record.name.startswith("lieint_jax")]
    assert message == f"XLA runs {step.name}, which is slower than machine code: KeyError: {name!r}"


@pytest.mark.quick
@pytest.mark.compared
@pytest.mark.slow
@pytest.mark.parametrize("reduce", [None, "energy"])
def test_machine_code_that_differs_from_xla_is_refused(monkeypatch, caplog, reduce):
    """A wrong formula of a primitive, of which nothing else would tell, in two runs; and if only `reduce` has it."""

    def potential(axis):  # of this test alone, so that no engine of it is in the cache
        return axis @ jnp.array([0.1, 0.2, 0.3]) + jnp.sin(axis[0])

    free = lambda axis: axis @ jnp.array([0.2, 0.1, 0.3])  # noqa: E731
    top = systems.potential_top([1.0, 2.0, 3.0], free if reduce else potential)
    step, states = schemes.splitting(top), jax.vmap(lambda w: top.state(angular_velocity=w))(normal(3))
    quantity = (lambda step, state: jnp.cos(state.p[0])) if reduce else None
    with monkeypatch.context() as patch:
        patch.setitem(ELEMENTWISE, "cos", lambda walk, x, dtype: walk.number("mul", x[0], x[0]))
        runs = [li.run(step, states, 0.1, n, reduce=quantity, progress=False, save_every=None) for n in (1, 2)]
    [message] = [record.getMessage() for record in caplog.records if record.name.startswith("lieint_jax")]
    assert message.startswith(f"XLA runs {step.name}, which is slower than machine code: in machine code a first step")
    expected = jax.jit(jax.vmap(lambda z: step(z, 0.1)[0]))(states)
    if reduce:
        change = np.cos(expected.p[:, 0]) - np.cos(states.p[:, 0])
        np.testing.assert_allclose(runs[0].summary.mean[-1], change.mean(), rtol=1e-13)
    else:
        np.testing.assert_allclose(runs[0].state.p[-1], expected.p, rtol=1e-14)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("ours", "theirs", "changed", "agree"),
    [
        (1.0, 1.0 + 1e-9, 1.0, True),
        (1.0, 1.0 + 1e-6, 1.0 + 1e-6, False),
        (1.0, 1.0 + 1e-6, 1.0 + 2e-6, True),  # rounding alone moves it as much
        (2e-17, 0.0, 1e-17, True),
        (2e-17, 0.0, 0.0, False),
        (np.nan, np.nan, np.nan, True),
        (0.0, np.nan, np.nan, False),
        (np.nan, 0.0, 0.0, False),
        (np.inf, np.inf, np.inf, True),
        (-np.inf, np.inf, np.inf, False),
        (1.0, np.nan, 1.0, True),  # rounding alone decides
        (1, 2, 2, False),
        (1, 2, 1, True),
    ],
)
def test_results_agree_up_to_what_rounding_does_to_xla(ours, theirs, changed, agree):
    assert _engine._agree(*(np.array([x]) for x in (ours, theirs, changed))) is agree


@pytest.mark.quick
def test_what_is_returned_may_be_known_shared_or_given():
    def function(x, flag, nothing, n, on, scale, rate):
        return {
            "known": (1.5, np.int32(3), True, np.arange(3), jnp.nan, -0.0),
            "shared": (n, on, n + 1, ~on, scale, rate * 2),
            "given": (x, flag, nothing),
            "entries": jnp.stack([x[0], scale, 2.0]),
            "flags": jnp.stack([flag, on, True]),
            "nothing": nothing + 1,
        }

    nothing = np.zeros((MEMBERS, 0))
    member = (normal(2), np.arange(MEMBERS) % 2 == 0, nothing)
    check_against_jax(function, member, [np.int64(3), np.bool_(True), 2.5, np.float32(3)], signs=True)


@pytest.mark.quick
def test_shared_tables_are_read_by_any_index():
    """A long shared array is read where a program needs it: by any index, and row by row."""
    table = np.random.default_rng(0).normal(size=300)
    whole = np.arange(1000)

    def function(x, k, table, whole, n):
        def stage(c, row):
            return c * 0.5 + row, None

        return {
            "shared": (table[n], whole[n + 1], table[299 + 0 * n]),
            "own": (table[k], table.at[k].get(mode="fill"), table.at[k].get(mode="clip"), whole.at[n].get(mode="fill")),
            "scan": lax.scan(stage, x, table)[0],
            "reverse": lax.scan(stage, x, table, reverse=True)[0],
            "loop": lax.fori_loop(0, n, lambda m, c: c + table[m], x),
        }

    k = np.random.default_rng(1).integers(-400, 700, MEMBERS)
    check_against_jax(function, (normal(), k), [table, whole, np.int64(250)], rtol=1e-13)
    check_against_jax(lambda x, table: lax.scan(lambda c, y: (c + y, None), x, table)[0], [normal()], [table[:100]])


def _step(x, rate):
    return lax.while_loop(lambda c: c[0] > 1e-3, lambda c: (c[0] * rate, c[1] + jnp.sin(c[0])), (x.sum(), x))


def _orbiting(x, e, steps):
    """Steps with a position on an orbit, by a loop that ends by a test, and stages that share more than that."""

    def step_once(n, x):
        M = 0.1 * n
        E = lax.while_loop(
            lambda c: abs(c[0] - e * jnp.sin(c[0]) - M) > 1e-12,
            lambda c: (c[0] - (c[0] - e * jnp.sin(c[0]) - M) / (1 - e * jnp.cos(c[0])), c[1] + 1),
            (M, 0),
        )[0]
        r = lax.cond(jnp.cos(E) > 0, lambda: 1 - e * jnp.cos(E), lambda: jnp.exp(-e))

        nodes = jnp.cos(E + jnp.arange(12.0))

        def stage(k, c):
            y, weight = c
            node, own = nodes[k], nodes[jnp.clip(5 * y, 0, 11).astype(int)]
            return y + weight * jnp.sin(r * y + node + own), weight * jnp.cos(0.01 * k)

        def sweep(k, y):
            size = lax.while_loop(lambda s: s > 1 + E * E, lambda s: 0.7 * s, 50.0)
            return 0.5 * y + 0.1 * jnp.sin(size * y)

        y, weight = lax.fori_loop(0, 7, stage, (x, 0.1 * r))
        y = lax.fori_loop(0, 40, sweep, y)
        return jnp.where(y > 3, y - 3, y) + 1e-3 * weight

    return lax.fori_loop(0, steps, step_once, x)


def test_what_members_share_in_a_loop_is_computed_once(monkeypatch):
    monkeypatch.setattr(_pieces, "_CAPACITY", 1)
    x, e = normal(), np.float64(0.3)
    kinds, example = ["member", "shared", "shared"], (0.5, e, np.int64(3))
    kernels = {lanes: Kernel(_orbiting, kinds, example, lanes) for lanes in (4, 8)}
    for steps in (3, 20, 0, 5):  # more numbers than there is room for at first, and fewer
        found = {lanes: kernel((x, e, np.int64(steps)), MEMBERS)[0] for lanes, kernel in kernels.items()}
        np.testing.assert_allclose(found[8], by_jax(_orbiting, [x], [e, np.int64(steps)]), rtol=0, atol=1e-12)
        assert bits(found[4]) == bits(found[8])
    assert [kernels[lanes].shared for lanes in (4, 8)] == [22, 22]


@pytest.mark.parametrize("room", [22, 88, 4096])
def test_what_members_share_goes_on_from_row_to_row(monkeypatch, room):
    monkeypatch.setattr(_pieces, "_CAPACITY", room)

    def rows(x, e, steps):
        end = _orbiting(x, e, steps)
        return end, end + e

    x, e, steps = normal(), np.float64(0.2), np.array([3, 0, 6, 1, 1, 2, 0, 0, 0, 0])
    kernel = Kernel(rows, ["carry", "shared", "row"], (0.5, e, np.int64(3)), 8)
    last, each = kernel((x, e, steps), MEMBERS, len(steps), 2)
    expected = x
    for found, count in zip(each, steps, strict=True):
        expected = by_jax(_orbiting, [expected], [e, count])
        np.testing.assert_allclose(found, expected + e, rtol=0, atol=1e-13)
    np.testing.assert_allclose(last, expected, rtol=0, atol=1e-13)


@pytest.mark.skipif(sys.platform != "linux", reason="mprotect of Linux")
def test_an_array_of_a_kernel_ends_at_an_unreadable_page():
    code = "import numpy as np, kernels, ctypes; x = kernels.guarded((5,), float); ctypes.memset(x.ctypes.data, 0, {})"
    lib = Path(__file__).parents[1] / "lib"
    ends = [subprocess.run([sys.executable, "-c", code.format(n)], cwd=lib).returncode for n in (40, 41)]
    assert ends == [0, -signal.SIGSEGV]


@pytest.mark.quick
@pytest.mark.parametrize("lanes", [4, 8, 16])
def test_bits_depend_on_no_order_lanes_threads_or_other_members(lanes):
    x = np.abs(np.random.default_rng(0).normal(size=(101, 2)))
    rate = np.float64(0.7)
    native = compiled(_step, [x], [rate], lanes=lanes)
    whole = compiled(_step, [x], [rate], lanes=8)([x])
    for threads in (1, 2, 3):
        assert bits(native([x], threads=threads)) == bits(whole)
    order = np.random.default_rng(1).permutation(len(x))
    assert bits(native([x[order]], threads=2)) == bits(jax.tree.map(lambda y: y[order], whole))
    assert bits(native([x[77:78]])) == bits(jax.tree.map(lambda y: y[77:78], whole))
    x[[3, 50]] = np.nan, 1e300
    others = np.delete(np.arange(len(x)), [3, 50])
    assert bits(jax.tree.map(lambda y: y[others], native([x]))) == bits(jax.tree.map(lambda y: y[others], whole))


def cache_below(monkeypatch, folder):
    """Let `folder` be that of JAX's cache, next to which machine code is kept."""
    config = SimpleNamespace(jax_compilation_cache_dir=str(folder))
    monkeypatch.setattr(_machine, "jax", SimpleNamespace(config=config))


@pytest.mark.quick
def test_machine_code_on_disk_is_checked(tmp_path, monkeypatch):
    """What is damaged, cut, empty or of another key is compiled again; a folder that cannot be written is no error."""
    key, other, compiled = "a" * 64, "b" * 64, []
    monkeypatch.setattr(_machine, "_compile", lambda *_: compiled.append(1) or b"code")
    cache_below(monkeypatch, tmp_path)

    def is_read(key):
        before = len(compiled)
        assert _machine._object_code(key, [], []) == b"code"
        return len(compiled) == before

    assert not is_read(key)
    assert is_read(key)
    file = tmp_path / "native" / key
    good = file.read_bytes()
    for bad in (good[:-1], good + b"x", b"", good[:10], bytes([good[0] ^ 1]) + good[1:], good[:-1] + b"f"):
        file.write_bytes(bad)
        assert not is_read(key)
        assert file.read_bytes() == good
    file.with_name(other).write_bytes(good)
    assert not is_read(other)
    cache_below(monkeypatch, file)  # no folder
    assert not is_read(key)


@pytest.mark.quick
def test_other_processors_have_other_keys(tmp_path, monkeypatch):
    cache_below(monkeypatch, tmp_path)
    text = "define void @run(i64 %a, i64 %b, i64 %c, i64 %d, ptr %p) {\n  ret void\n}\n"
    MachineFunction(text)
    monkeypatch.setattr(_machine.llvm, "get_host_cpu_features", lambda: SimpleNamespace(flatten=lambda: "+sse2"))
    MachineFunction(text)
    assert len(list((tmp_path / "native").iterdir())) == 2


WITHOUT = """
import sys, logging
sys.modules["llvmlite"] = None
logging.basicConfig(format="%(message)s")
import jax, numpy as np, lieint_jax as li
body = li.systems.rigid_body([1.0, 2.0, 3.0])
states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.ones((3, 3)))
step = li.schemes.so3_midpoint(body)
for _ in range(2):
    assert li.run(step, states, dt=0.1, num_steps=3, progress=False).converged.all()
assert li.integrate(step, jax.tree.map(lambda x: x[0], states), dt=0.1, num_steps=3).info.converged.all()
assert li.run(li.schemes.exact(body), states, dt=0.1, num_steps=3, progress=False).engine == "xla"
"""


def test_without_llvmlite_everything_runs_by_xla_and_one_sentence_names_the_remedy():
    told = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    sentence = "XLA runs every loop, which is slower than machine code: llvmlite, the compiler of machine code, is not"
    assert told.stderr.splitlines() == [f"{sentence} installed (pip install llvmlite)"]
