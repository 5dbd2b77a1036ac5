"""Functions of one member as machine code for many, beside what JAX makes of them, for tests."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from kernels import Kernel

MEMBERS = 13  # not a multiple of the members in a vector


def member_shape(x):
    """The shape of one member's part of an array."""
    return jax.ShapeDtypeStruct(np.shape(x)[1:], np.asarray(x).dtype)


def compiled(function, member, shared=(), *, lanes=8):
    """`function(*member, *shared)` as machine code: (member, shared, threads) ↦ its results, axis of members first."""
    kinds = ["member"] * len(member) + ["shared"] * len(shared)
    kernel = Kernel(function, kinds, (*jax.tree.map(member_shape, tuple(member)), *shared), lanes)

    def call(member, shared=shared, threads=1):
        found = kernel((*member, *shared), len(jax.tree.leaves(member)[0]), threads=threads)
        return jax.tree.map(lambda x: x[0], found)

    return call


def by_jax(function, member, shared=()):
    """The same results by `jax.vmap` and XLA."""
    axes = (0,) * len(member) + (None,) * len(shared)
    return jax.jit(jax.vmap(function, axes))(*member, *shared)


def check_against_jax(function, member, shared=(), *, rtol=0.0, atol=0.0, signs=False, lanes=8):
    """Types, shapes and values are JAX's; integers, truth values, NaN and infinities exactly, and signs if so asked."""
    found = compiled(function, member, shared, lanes=lanes)(member)
    expected = by_jax(function, member, shared)
    pairs = zip(jax.tree.leaves_with_path(expected), jax.tree.leaves(found), strict=True)
    for (path, wanted), x in pairs:
        name, wanted = jax.tree_util.keystr(path), np.asarray(wanted)
        assert (x.dtype, x.shape) == (wanted.dtype, wanted.shape), name
        if wanted.dtype.kind == "f":
            np.testing.assert_allclose(x, wanted, rtol=rtol, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(x, wanted, err_msg=name)
        if signs and wanted.dtype.kind == "f":
            known = ~np.isnan(wanted)
            np.testing.assert_array_equal(np.signbit(x)[known], np.signbit(wanted)[known], err_msg=name)


def bits(tree):
    """The bytes of all arrays of a tree."""
    return [np.asarray(x).tobytes() for x in jax.tree.leaves(tree)]


def stacking(x, weights, k):
    """Rows that loops write and other loops read, in any order; a gradient through 40 stages; entries by an index."""

    def stage(c, row):
        return jnp.sin(c) + row, (c[0] * c, c > 0, jnp.int32(3) * row[0].astype(int), row[:, None] * weights[0], 2.5)

    end, rows = lax.scan(stage, x, weights)
    back = lax.scan(lambda c, row: (0.9 * c + row[0] * row[1] + row[3][:, 0] * row[4], c), end, rows, reverse=True)

    def through(x):
        return lax.fori_loop(0, 40, lambda n, y: y + 0.1 * weights[n % 20] * jnp.sin(y) * y[::-1], x).sum()

    def repeated(c):  # rows inside of a loop of each member
        c, inner = lax.scan(lambda c, row: (c + 0.1 * row, jnp.cos(c)), c, weights)
        return c - 3.0 * lax.scan(lambda s, row: (s + row, None), jnp.zeros(2), inner)[0] / 20

    many = lax.while_loop(lambda c: c[1] < 2 + x[0], lambda c: (repeated(c[0]), c[1] + 1), (x, 0))[0]
    return back, rows[0][k], rows[1][3], rows[2], rows[3][::-2], rows[4].sum(), jax.grad(through)(x), many
