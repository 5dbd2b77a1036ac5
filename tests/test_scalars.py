"""Functions of small arrays as arithmetic of numbers: the same results, and no array in the program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax._numerics import scalars

A, B = (jnp.asarray(np.random.default_rng(n).normal(size=(3, 3))) for n in (0, 1))
V = jnp.asarray([0.3, -0.7, 1.1])


@jax.custom_jvp
def tripled(x):
    return 3 * x


tripled.defjvp(lambda primals, tangents: (tripled(*primals), 3 * tangents[0]))

FUNCTIONS = {
    "products of matrices": lambda A, B, v: (A @ B @ v, A.T @ B, jnp.einsum("ij,kj->ik", A, B), v @ v),
    "a batch of them": lambda A, B, v: jnp.einsum("nij,nj->ni", jnp.stack([A, B]), jnp.stack([v, 2 * v])),
    "entries moved": lambda A, B, v: (
        jnp.concatenate([A[1:, ::-1].ravel(), v[:2]]),
        jnp.roll(v, 1),
        jnp.stack([v, B[0]], axis=1),
        jnp.pad(v, (1, 2), constant_values=0.5),
        jnp.tile(v, 2),
        jnp.split(A, 3),
    ),
    "sums and extremes": lambda A, B, v: (A.sum(0), A.max(), B.min(axis=1), jnp.prod(v), jnp.trace(A @ B)),
    "functions": lambda A, B, v: (
        jnp.where(v > 0, jnp.sin(v), jnp.exp(v)) ** 3,
        jnp.arctan2(v, A[0]),
        jnp.clip(v, -0.5, 0.5) / jnp.sqrt(1 + A[1] ** 2),
        jnp.hypot(v, B[2]),
    ),
    "a gradient": lambda A, B, v: jax.grad(lambda v: jnp.cos(v @ A @ v) + jnp.sum(v[1:] ** 3) + v[0] * v[2])(v),
    "constants": lambda A, B, v: jnp.asarray([[1.0, 2, 3], [4, 5, 6]]) @ v + 0.5,
    "calls": lambda A, B, v: (jax.jit(lambda x: x @ x)(v), tripled(v), jax.checkpoint(jnp.sin)(v)),
    "of no number at all": lambda A, B, v: (jnp.zeros(2), v),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_results_are_the_same(name):
    function, numbers = FUNCTIONS[name], [*A.ravel(), *B.ravel(), *V]
    program, shapes = scalars.flat(function, A, B, V)
    assert all(x.aval.shape == () for equation in program.jaxpr.eqns for x in (*equation.invars, *equation.outvars))
    found = jax.jit(jax.extend.core.jaxpr_as_fun(program))(*numbers)
    wanted = jax.jit(function)(A, B, V)
    assert jax.tree.map(jnp.shape, wanted) == jax.tree.map(lambda s: s.shape, shapes)
    flat = np.concatenate([np.ravel(x) for x in jax.tree.leaves(wanted)])
    np.testing.assert_allclose(np.stack(found), flat, rtol=4e-15, atol=1e-15)  # observed: 7e-16


def test_what_is_not_needed_is_known():
    program, _ = scalars.flat(lambda A, v: (jnp.sin(A) * 2, A[1] @ v)[1], A, V)
    assert scalars.used(program.jaxpr) == [False] * 3 + [True] * 3 + [False] * 3 + [True] * 3


@pytest.mark.parametrize(
    "function", [jnp.cumsum, jnp.sort, jnp.linalg.inv, lambda A: jax.lax.fori_loop(0, 3, lambda _, x: x @ A, A)]
)
def test_what_is_no_arithmetic_is_refused(function):
    with pytest.raises(scalars.NotArithmeticError):
        scalars.flat(function, A)


def test_single_precision_stays_single():
    program, _ = scalars.flat(lambda v: 2.0 * v + jnp.asarray([1, 2, 3], jnp.float32), V.astype(jnp.float32))
    assert {x.dtype for x in program.out_avals} == {jnp.dtype("float32")}
