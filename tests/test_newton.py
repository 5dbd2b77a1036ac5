"""Newton in custom_root, on problems of its own: derivatives by the implicit function theorem in every dimension."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax._numerics import newton, unrolled


def cubic_root(c, iterations=8):
    """x + |x|²x = c, in any dimension."""

    def residual(x):
        return x + jnp.sum(x * x) * x - c

    def correction(x, f):
        if x.ndim == 0:
            return f / (1 + 3 * x * x)
        K = (1 + x @ x) * jnp.eye(x.size) + 2 * jnp.outer(x, x)
        return jnp.linalg.solve(K, f)

    return newton.root(residual, correction, c / 2, iterations)


@pytest.mark.parametrize("c", [0.7, [0.3, -0.5], [0.3, -0.5, 0.4], [0.1, 0.2, 0.3, -0.4, 0.5]])
def test_root_residual_and_derivatives_in_dimensions_0_to_5(c):
    c = jnp.array(c)
    x, residual = cubic_root(c)
    assert jnp.abs(residual).max() < 4e-16
    K = np.linalg.inv(np.atleast_2d((1 + jnp.sum(x * x)) * jnp.eye(max(c.size, 1)) + 2 * jnp.outer(x, x)))
    for jacobian in (jax.jacfwd, jax.jacrev):
        J = jax.jit(jacobian(lambda c: cubic_root(c)[0]))(c)
        np.testing.assert_allclose(np.atleast_2d(J), K, atol=4e-16)
    batch = jax.vmap(lambda s: cubic_root(s * c)[0])(jnp.linspace(-1, 1, 5))
    np.testing.assert_allclose(batch[-1], x, atol=4e-16)


def by_chords(c, iterations=8, wrong=0.0):
    """The same equation, x a list; `wrong` spoils the matrix."""

    def residual(x):
        square = unrolled.dot(x, x)
        return [a + square * a - b for a, b in zip(x, c, strict=True)]

    def factored(x, F):
        one = jnp.stack(x)
        K = (1 + wrong + one @ one) * jnp.eye(len(x)) + 2 * jnp.outer(one, one)
        return unrolled.factored(unrolled.as_list(K))

    return newton.chords(residual, factored, lambda F: jnp.abs(jnp.stack(F)).max(), [x / 2 for x in c], iterations)


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_chords_end_at_round_off_whatever_the_matrix(wrong):
    """Root, derivatives and batches as of `root`; a matrix off by 5 % costs turns, not digits."""
    c = jnp.array([0.3, -0.5, 0.4])
    run = jax.jit(lambda c: by_chords(unrolled.as_list(c), wrong=wrong))
    x, (F, determinant) = run(c)
    assert np.abs(F).max() < 3e-16
    assert determinant > 0
    exact = cubic_root(c)[0]
    np.testing.assert_allclose(np.stack(x), exact, atol=3e-16)
    J = jax.jacrev(lambda c: jnp.stack(run(c)[0]))(c)
    K = (1 + exact @ exact) * np.eye(3) + 2 * np.outer(exact, exact)
    np.testing.assert_allclose(J @ K, np.eye(3), atol=4e-16)
    scales = jnp.array([0.1, 1.0, 6.0])
    batch = jax.vmap(lambda s: jnp.stack(run(s * c)[0]))(scales)
    np.testing.assert_array_equal(batch[1], np.stack(x))  # a member that is done does not move any more
    assert np.abs(jax.vmap(lambda s: jnp.stack(run(s * c)[1][0]))(scales)).max() < 4e-15


def test_chords_too_few_show_in_the_residual():
    _, (F, _) = by_chords([jnp.array(x) for x in (3.0, -5.0, 4.0)], iterations=1)
    assert np.abs(F).max() > 1e-6


def test_a_fixed_count_that_is_too_small_shows_in_the_residual():
    _, residual = cubic_root(jnp.array([3.0, -5.0, 4.0]), iterations=1)
    assert jnp.abs(residual).max() > 0.1


def test_nested_transformations():
    """grad of a scan of roots, forward over reverse, under jit and vmap."""

    def run(c):
        return jax.lax.scan(lambda x, _: (cubic_root(x + c)[0], None), jnp.zeros(3), None, length=5)[0].sum()

    cs = jnp.array([[0.1, 0.2, 0.3], [0.3, 0.2, -0.1]])
    H = jax.jit(jax.vmap(jax.jacfwd(jax.grad(run))))(cs)
    np.testing.assert_allclose(H, jnp.swapaxes(H, 1, 2), atol=1e-15)
    h = 1e-5
    g = jax.grad(run)
    numeric = (g(cs[0] + h * jnp.eye(3)[0]) - g(cs[0] - h * jnp.eye(3)[0])) / (2 * h)
    np.testing.assert_allclose(H[0, 0], numeric, atol=1e-9)
