"""Tiny linear algebra against numpy; every series branch against mpmath on both sides of its threshold."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lieint_jax._numerics import power_series, vec3

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
    S, v = vec3.symmetric(J), RNG.normal(size=3)
    adj = vec3.adjugate(S)
    scale = 64 * EPS * np.linalg.norm(M) ** 3
    np.testing.assert_allclose(vec3.apply(S, v), M @ v, rtol=0, atol=scale)
    np.testing.assert_allclose(vec3.apply(adj, v), np.linalg.det(M) * np.linalg.inv(M) @ v, rtol=0, atol=scale)
    np.testing.assert_allclose(vec3.determinant(S, adj), np.linalg.det(M), rtol=0, atol=scale)
    np.testing.assert_allclose(vec3.trace(S), np.trace(M), rtol=0, atol=scale)
    np.testing.assert_allclose(vec3.solve_symmetric(S, v), np.linalg.solve(M, v), rtol=0, atol=64 * EPS)


def test_the_inverse_inertia_of_an_asteroid_is_accurate_in_float32():
    J = jnp.array(spd(True) * 1e20, jnp.float32)
    x = vec3.solve_symmetric(vec3.symmetric(J), jnp.array([1e20, 2e20, -1e20], jnp.float32))
    np.testing.assert_allclose(x, np.linalg.solve(np.array(J, float), [1e20, 2e20, -1e20]), rtol=1e-5)


def test_solve_agrees_with_numpy():
    K, b = RNG.normal(size=(3, 3)) + 3 * np.eye(3), RNG.normal(size=3)
    np.testing.assert_allclose(vec3.solve(K, b), np.linalg.solve(K, b), rtol=0, atol=32 * EPS)


def test_products_of_vectors_agree_with_numpy():
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(vec3.cross(a, b), np.cross(a, b), rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(vec3.dot(a, b), a @ b, rtol=0, atol=4 * EPS)
    assert vec3.max_abs(jnp.array(a)) == np.abs(a).max()


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
