"""Newton in custom_root, on problems of its own: derivatives by the implicit function theorem in every dimension."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax._numerics import newton
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.vectors import Vector


def cubic_root(c, iterations=8):
    """x + |x|²x = c, in any dimension."""

    def residual(x):
        return x + jnp.sum(x * x) * x - c

    def correction(x, f):
        """(1 + |x|² + 2x⊗x)⁻¹f."""
        square = jnp.sum(x * x)
        return (f - 2 * jnp.sum(x * f) / (1 + 3 * square) * x) / (1 + square)

    return newton.root(residual, correction, c / 2, iterations)


@jax.jit
def _at_the_root(c):
    """x, its residual, dx/dc forward and in reverse, and x of the last of a batch of multiples of c."""
    root = lambda c: cubic_root(c)[0]  # noqa: E731
    batch = jax.vmap(lambda s: root(s * c))(jnp.linspace(-1, 1, 5))
    return *cubic_root(c)[:2], jax.jacfwd(root)(c), jax.jacrev(root)(c), batch[-1]


@pytest.mark.slow
@pytest.mark.parametrize("c", [0.7, [0.3, -0.5], [0.3, -0.5, 0.4], [0.1, 0.2, 0.3, -0.4, 0.5]])
def test_root_residual_and_derivatives_in_dimensions_0_to_5(c):
    c = np.array(c)
    x, residual, forward, reverse, last = jax.device_get(_at_the_root(c))
    assert np.abs(residual).max() < 4e-16
    K = np.linalg.inv(np.atleast_2d((1 + np.sum(x * x)) * np.eye(max(c.size, 1)) + 2 * np.outer(x, x)))
    for J in (forward, reverse):
        np.testing.assert_allclose(np.atleast_2d(J), K, rtol=0, atol=4e-16)
    np.testing.assert_allclose(last, x, rtol=0, atol=4e-16)


@pytest.mark.long
def test_second_derivatives_of_a_scalar_root_in_every_nesting():
    """x + x³ = c has x″ = −6x/(1 + 3x²)³; so has a run of steps, forward over reverse through a scan."""

    def x(c):
        return cubic_root(c)[0]

    def run(c):
        return jax.lax.scan(lambda x, _: (cubic_root(x + c)[0], None), jnp.zeros(()), None, length=3)[0]

    @jax.jit
    def all_of_them(c):
        forward, reverse = jax.jacfwd, jax.grad
        nested = [one(other(x))(c) for one in (forward, reverse) for other in (forward, reverse)]
        return x(c), nested, reverse(run)(c), forward(reverse(run))(c)

    c, h = 0.7, 1e-5
    root, nested, _, second = all_of_them(c)
    np.testing.assert_allclose(nested, -6 * root / (1 + 3 * root**2) ** 3, rtol=0, atol=1e-15)
    numeric = (all_of_them(c + h)[2] - all_of_them(c - h)[2]) / (2 * h)
    assert second == pytest.approx(float(numeric), abs=1e-9)


def by_chords(c, iterations=8, wrong=0.0):
    """The same equation, x a vector of scalars; `wrong` spoils the matrix."""

    def residual(x):
        square = x @ x
        return x + square * x - c

    def factored(x, F):
        one = jnp.stack(x)
        K = (1 + wrong + one @ one) * jnp.eye(len(x)) + 2 * jnp.outer(one, one)
        return la.factored(la.unrolled(K))

    def largest(F):
        return jnp.abs(jnp.stack(F)).max()

    return newton.chords(residual, factored, largest, largest, jax.tree.map(jnp.ones_like, c), 0.5 * c, iterations)


@pytest.mark.long
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_chords_end_at_round_off_whatever_the_matrix(wrong):
    """Root, derivatives and batches as in `root`; a matrix off by 5 % costs turns, not digits."""
    c, scales = np.array([0.3, -0.5, 0.4]), np.array([0.1, 1.0, 6.0])

    @jax.jit
    def run(c):
        solve = lambda c: by_chords(la.unrolled(c), wrong=wrong)  # noqa: E731
        x = lambda c: jnp.stack(solve(c)[0])  # noqa: E731
        batch = jax.vmap(lambda s: (x(s * c), jnp.stack(solve(s * c)[1])))(scales)
        return x(c), (solve(c)[1], solve(scales[0] * c)[2]), cubic_root(c)[0], jax.jacrev(x)(c), batch

    x, (F, on_branch), exact, J, (batch, residuals) = jax.device_get(run(c))
    assert np.abs(np.stack(F)).max() < 3e-16
    assert on_branch
    np.testing.assert_allclose(x, exact, rtol=0, atol=3e-16)
    K = (1 + exact @ exact) * np.eye(3) + 2 * np.outer(exact, exact)
    np.testing.assert_allclose(J @ K, np.eye(3), rtol=0, atol=4e-16)
    np.testing.assert_array_equal(batch[1], x)  # a member that is done does not move any more
    assert np.abs(residuals).max() < 4e-15


def test_chords_too_few_show_in_the_residual():
    _, F, _ = jax.jit(lambda c: by_chords(c, iterations=1))(Vector((3.0, -5.0, 4.0)))
    assert np.abs(np.stack(F)).max() > 1e-6


@pytest.mark.parametrize(("push", "is_steady"), [(0.01, True), (0.6, False)])
def test_a_correction_by_an_old_matrix_does_not_limit_the_next(push, is_steady):
    """x = 1, y (1 + 1.2 x) = push x² from 0: the matrix of the start gives y = push, a new one corrects 0.55 of it.

    If push > ½, the second correction is more than half of the first.
    """

    def residual(z):
        x, y = z
        return jnp.stack([x - 1, y * (1 + 1.2 * x) - push * x * x])

    def factored(z):
        x, y = z
        slopes = 1.2 * y - 2 * push * x, 1 + 1.2 * x
        return la.Factored(lambda F: jnp.stack([F[0], (F[1] - slopes[0] * F[0]) / slopes[1]]), jnp.asarray(True))

    def largest(step):
        return jnp.max(jnp.abs(step))

    eps = jnp.asarray(np.finfo(float).eps)
    z, missing = jax.jit(lambda z: newton.repeated_chords(residual, factored, largest, z, 1.0, eps, 50))(np.zeros(2))
    np.testing.assert_allclose(z, [1, push / 2.2], rtol=0, atol=1e-15)
    assert (missing <= eps) == is_steady


def test_a_fixed_count_that_is_too_small_shows_in_the_residual():
    _, residual, _ = jax.jit(lambda c: cubic_root(c, iterations=1))(np.array([3.0, -5.0, 4.0]))
    assert np.abs(residual).max() > 0.1


@pytest.mark.long
def test_roots_differentiate_in_nested_transformations():
    """grad of a scan of roots, forward over reverse, under jit and vmap."""

    def run(c):
        return jax.lax.scan(lambda x, _: (cubic_root(x + c)[0], None), jnp.zeros(3), None, length=5)[0].sum()

    cs = np.array([[0.1, 0.2, 0.3], [0.3, 0.2, -0.1]])
    slopes, h = jax.jit(jax.vmap(lambda c: (jax.grad(run)(c), jax.jacfwd(jax.grad(run))(c)))), 1e-5
    _, H = slopes(cs)
    np.testing.assert_allclose(H, np.swapaxes(H, 1, 2), rtol=0, atol=1e-14)
    (ahead, behind), _ = jax.device_get(slopes(cs[0] + h * np.array([[1.0, 0, 0], [-1, 0, 0]])))
    np.testing.assert_allclose(H[0, 0], (ahead - behind) / (2 * h), rtol=0, atol=2e-8)
