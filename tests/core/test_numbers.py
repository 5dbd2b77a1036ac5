"""Loops of programs of single numbers: the same results as on whole arrays, whatever the function is made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lieint_jax as li

MATRIX = np.array([[2.0, 0.3], [-0.4, 3.0]])


def solved(b):
    """MATRIX⁻¹ b, by an equation whose derivative is known."""
    det = MATRIX[0, 0] * MATRIX[1, 1] - MATRIX[0, 1] * MATRIX[1, 0]
    inverse = np.array([[MATRIX[1, 1], -MATRIX[0, 1]], [-MATRIX[1, 0], MATRIX[0, 0]]]) / det
    return lax.custom_linear_solve(lambda v: jnp.asarray(MATRIX) @ v, b, lambda _, b: jnp.asarray(inverse) @ b)


def by_slices(v, x):
    """A function whose derivative pads: before and after slices of two entries, and between every other one."""
    w = jnp.concatenate([v, x * v])
    return jnp.sum(jnp.sin(w[1:3]) * w[:2]) + jnp.sum(w[::2] ** 2)


FUNCTIONS = {
    "zeros and ones": lambda v, x: jnp.stack([v[1] - 0.0 * v[0] + x, 1.0 * v[0] + -(0.0 * v[1])]),
    "rows and columns": lambda v, x: jnp.sum(jnp.ones((3, 1)) * v[None, :] * x, axis=0) / 4,
    "a large array": lambda v, x: v + x * jnp.sum(jnp.full((9, 9), 0.01) * v[0]),
    "an equation": lambda v, x: solved(v * x) + x,
    "a derivative by slices": lambda v, x: jax.grad(by_slices)(v, x) / 8,
    "a derivative": lambda v, x: jax.grad(lambda w: jnp.sum(w[::-1] ** 2 * jnp.sin(w)) + x * w[1])(v) / 8,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_loop_through_single_numbers_is_that_of_arrays(name):
    function, start, over = FUNCTIONS[name], np.array([0.3, -0.7]), np.array([0.5, -0.25, 0.75] * 2)
    found, _ = jax.jit(lambda v: li.scan(lambda v, x: (function(v, x), None), v, over))(start)
    expected, once = start, jax.jit(function)
    for x in over:
        expected = once(expected, x)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
