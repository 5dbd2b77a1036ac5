"""Tiny linear algebra against numpy; every series branch against mpmath on both sides of its threshold."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lieint_jax._numerics import power_series, vectors

EPS = np.finfo(float).eps
RNG = np.random.default_rng(11)


def spd(full):
    A = RNG.normal(size=(3, 3))
    S = A @ A.T + np.eye(3)
    return S if full else np.diag(S)


@pytest.mark.parametrize("full", [False, True])
def test_symmetric_matrices_multiply_and_invert_as_by_numpy(full):
    J = jnp.array(spd(full))
    M = np.array(J) if full else np.diag(J)
    S, v = vectors.symmetric(J), RNG.normal(size=3)
    scale = 64 * EPS * np.linalg.norm(M) ** 3
    np.testing.assert_allclose(S @ v, M @ v, rtol=0, atol=scale)
    np.testing.assert_allclose(S.adjugate @ v, np.linalg.det(M) * np.linalg.inv(M) @ v, rtol=0, atol=scale)
    np.testing.assert_allclose(S.det(S.adjugate), np.linalg.det(M), rtol=0, atol=scale)
    np.testing.assert_allclose(S.trace, np.trace(M), rtol=0, atol=scale)
    np.testing.assert_allclose(S.solve(v), np.linalg.solve(M, v), rtol=0, atol=64 * EPS)
    np.testing.assert_allclose(S.inverse_trace, np.trace(np.linalg.inv(M)), rtol=64 * EPS)
    np.testing.assert_allclose(vectors.inverse(J).rows, np.linalg.inv(M), rtol=0, atol=64 * EPS)
    np.testing.assert_allclose(S @ vectors.matrix(jnp.array(M)), M @ M, rtol=0, atol=scale)


def test_the_inverse_inertia_of_an_asteroid_is_accurate_in_float32():
    J = jnp.array(spd(True) * 1e20, jnp.float32)
    x = vectors.symmetric(J).solve(jnp.array([1e20, 2e20, -1e20], jnp.float32))
    np.testing.assert_allclose(x, np.linalg.solve(np.array(J, float), [1e20, 2e20, -1e20]), rtol=1e-5)


def test_solve_agrees_with_numpy():
    K, b = RNG.normal(size=(3, 3)) + 3 * np.eye(3), RNG.normal(size=3)
    for divide in (False, True):
        x = vectors.Matrix(K).solve(b, 2, divide)
        np.testing.assert_allclose(x, np.linalg.solve(2 * K, b), rtol=0, atol=32 * EPS)


def test_matrices_agree_with_numpy():
    X, Y, v = *RNG.normal(size=(2, 3, 3)), RNG.normal(size=3)
    A, B = vectors.matrix(jnp.array(X)), vectors.Matrix(Y)
    pairs = [(A @ B, X @ Y), (A.T @ B, X.T @ Y), (A + 2.0 * B, X + 2 * Y), (A @ v, X @ v), (A.array, X)]
    pairs += [(A.gram().rows, X.T @ X), (A.plus_transpose().rows, X + X.T), (A.det(), np.linalg.det(X))]
    pairs += [(A.cofactors, np.linalg.det(X) * np.linalg.inv(X).T), (vectors.hat(v) @ X[0], np.cross(v, X[0]))]
    pairs += [(A @ B.gram(), X @ (Y.T @ Y)), (A - B.gram(), X - Y.T @ Y), (A.times_hat(v), X @ vectors.hat(v).array)]
    for ours, theirs in pairs:
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=64 * EPS)
    S, R = A.plus_transpose(), B.plus_transpose()
    np.testing.assert_allclose(S.inner(R), np.sum((X + X.T) * (Y + Y.T)), rtol=64 * EPS)


@pytest.mark.parametrize(("values", "positive"), [((1, 2, 3), True), ((-1, -2, 3), False), ((-1, 2, 3), False)])
def test_signs_of_eigenvalues(values, positive):
    Q = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    S = Q @ np.diag(np.array(values, float)) @ Q.T
    assert vectors.matrix(jnp.array(S)).no_negative_eigenvalue == positive
    assert vectors.symmetric(jnp.array(S)).positive_definite == positive


def test_operators_agree_with_numpy():
    a, b, s = *RNG.normal(size=(2, 3)), 0.7
    v, w = vectors.vector(jnp.array(a)), vectors.Vector(b)
    found = [v + w, v - w, -v, s * v, v * s, v / s]
    found += [v + jnp.array(b), jnp.array(b) + v, jnp.array(b) - v, b - v, sum((v, w))]
    found += [np.float64(s) * v, np.array(s) * v, jnp.array(s) * v]  # NumPy would give an array
    wanted = [a + b, a - b, -a, s * a, s * a, a / s, a + b, a + b, b - a, b - a, a + b, s * a, s * a, s * a]
    for ours, theirs in zip(found, wanted, strict=True):
        assert isinstance(ours, vectors.Vector)
        np.testing.assert_array_equal(ours, theirs)
    diagonal = vectors.symmetric(jnp.array(a))
    np.testing.assert_array_equal((diagonal + s * diagonal).full, [*(a + s * a), 0, 0, 0])
    np.testing.assert_array_equal(vectors.outer(v, w), np.outer(a, b))


@pytest.mark.parametrize("kind", [vectors.vector, vectors.symmetric, vectors.matrix])
def test_vectors_and_tensors_are_pytrees(kind):
    x = kind(jnp.array(spd(kind is not vectors.vector)))
    slope = jax.grad(lambda y: sum(leaf**2 for leaf in jax.tree.leaves(y)))(x)
    assert type(slope) is type(x)
    np.testing.assert_array_equal(slope, 2.0 * x)
    carried = jax.lax.while_loop(lambda y: jax.tree.leaves(y)[0] < 100, lambda y: 2.0 * y, x)
    assert type(carried) is type(x)
    assert jax.tree.leaves(carried)[0] >= 100


def test_products_of_vectors_agree_with_numpy():
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(vectors.cross(a, b), np.cross(a, b), rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(vectors.dot(a, b), a @ b, rtol=0, atol=4 * EPS)
    assert vectors.max_abs(jnp.array(a)) == np.abs(a).max()
    assert vectors.max_abs(vectors.Vector(a), vectors.Vector(b)) == max(np.abs(a).max(), np.abs(b).max())


FUNCTIONS = {
    "cos_sqrt": (power_series.cos_sqrt, lambda x: mpmath.cos(mpmath.sqrt(x)), 1.0),
    "sinc_sqrt": (power_series.sinc_sqrt, lambda x: mpmath.sinc(mpmath.sqrt(x)), 1.0),
    "arctan_sqrt": (power_series.arctan_sqrt, lambda x: mpmath.atan(mpmath.sqrt(x)) / mpmath.sqrt(x), 0.1),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FUNCTIONS)
def test_series_branches_have_accurate_values_and_two_derivatives(name):
    ours, exact, threshold = FUNCTIONS[name]
    first, second = jax.grad(ours), jax.grad(jax.grad(ours))
    with mpmath.workdps(40):
        for x in (threshold * (1 - 1e-15), threshold, threshold * (1 + 1e-15), threshold / 7, 3 * threshold, 9.0):
            point = mpmath.mpf(x)
            for k, (f, bound) in enumerate(((ours, 4), (first, 16), (second, 200))):
                value, true = float(f(jnp.array(x))), float(mpmath.diff(exact, point, k))
                assert abs(value - true) <= bound * EPS, (k, x)  # closed forms lose a digit a derivative, no more


@pytest.mark.long
@pytest.mark.parametrize("name", FUNCTIONS)
def test_series_branches_are_exact_at_zero(name):
    ours, exact, _ = FUNCTIONS[name]
    with mpmath.workdps(40):
        taylor = [float(c) for c in mpmath.taylor(exact, mpmath.mpf("1e-30"), 2)]
    zero = jnp.array(0.0)
    values = [float(f(zero)) for f in (ours, jax.grad(ours), jax.grad(jax.grad(ours)))]
    np.testing.assert_allclose(values, [taylor[0], taylor[1], 2 * taylor[2]], rtol=0, atol=1e-15)
