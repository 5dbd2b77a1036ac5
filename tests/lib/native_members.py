"""Functions of one member as machine code for many, beside what JAX makes of them, for tests."""

import jax
import numpy as np

from lieint_jax.native import Kernel

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
