"""Student's t in fits: the likelihood, its derivatives, its estimates; and models that run member by member."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import lieint_jax as li

ERRORS = np.random.default_rng(3).standard_t(3, size=(12, 3))


def log_likelihood(errors, noise, freedom):
    return stats.multivariate_t.logpdf(errors, shape=noise**2 * np.eye(3), df=freedom)


@pytest.mark.parametrize("freedom", [1.0, 4.0, 30.0])
def test_half_the_sum_of_squares_is_the_negative_log_likelihood(freedom):
    def ours(noise):
        parts = li.fitting.student_t(jnp.asarray(ERRORS), noise, 0.01, freedom)
        return sum(float(jnp.sum(part**2)) for part in parts) / 2

    def theirs(noise):
        return -log_likelihood(ERRORS, noise, freedom).sum()

    assert ours(0.7) - ours(2.5) == pytest.approx(theirs(0.7) - theirs(2.5), rel=1e-12, abs=0)


@pytest.mark.long
def test_it_is_smooth_where_an_error_vanishes():
    def short(e):
        return li.fitting.student_t(e, 2.0, 0.01)[0]

    slope = jax.jit(jax.jacfwd(short))
    J = slope(jnp.zeros((1, 3)))[0, :, 0]
    np.testing.assert_allclose(J, np.sqrt(7 / 4) / 2 * np.eye(3), rtol=1e-15)
    for u in (0.99e-8, 1.01e-8):  # both sides of the threshold of the series
        e = jnp.array([[np.sqrt(4 * u) * 2.0, 0.0, 0.0]])
        expected = np.sqrt(7 * np.log1p(u))
        assert float(short(e)[0, 0]) == pytest.approx(expected, rel=1e-14, abs=0)
    np.testing.assert_array_less(np.abs(slope(e)[0, :, 0] - J), 2e-8)


def test_the_curvature_is_the_second_derivative_of_the_likelihood():
    likelihood = partial(log_likelihood, noise=1.3, freedom=4)
    h = 1e-3 * np.eye(3)
    pairs = [[likelihood(ERRORS + a + b) for b in (*h, *-h)] for a in (*h, *-h)]
    f = np.array(pairs).reshape(2, 3, 2, 3, -1)
    hessian = -(f[0, :, 0] - f[0, :, 1] - f[1, :, 0] + f[1, :, 1]) / 4e-6
    ours = li.fitting.student_t_curvature(jnp.asarray(ERRORS), 1.3)
    np.testing.assert_allclose(ours, np.moveaxis(hessian, -1, 0), rtol=0, atol=1e-6)  # 3e-7


def test_the_noise_error_is_the_spread_of_the_score():
    for d, freedom in ((3, 4.0), (2, 9.0)):
        score = (freedom + d) * np.sqrt(stats.beta(d / 2, freedom / 2).var())  # of d − (ν + d)|e|²/(νσ² + |e|²)
        exact = 1 / (score * np.sqrt(17))
        assert li.fitting.student_t_noise_error(17, d, freedom) == pytest.approx(exact, rel=1e-14, abs=0)
    normal = (2 * 3 * 50) ** -0.5
    assert li.fitting.student_t_noise_error(50, 3, 1e9) == pytest.approx(normal, rel=1e-8)  # observed 3e-9


@pytest.mark.long
def test_the_estimate_is_the_fixed_point_of_reweighting_and_leaves_an_outlier_out():
    seen = np.vstack([ERRORS, [[40.0, 0.0, 0.0]]])

    def residuals(p):
        return li.fitting.student_t(p["mean"] - seen, p["noise"], 1e-3)

    bounds = {"mean": li.fitting.free, "noise": li.fitting.interval(1e-3, 1e3)}
    guess = {"mean": jnp.zeros(3), "noise": jnp.array(5.0)}
    found = li.fit(residuals, guess, bounds=bounds, tolerance=1e-12, progress=False)
    assert found.success
    mean, noise = np.asarray(found.params["mean"]), float(found.params["noise"])
    w = np.asarray(li.fitting.student_t_weights(jnp.asarray(mean - seen), noise))
    np.testing.assert_allclose(mean, w @ seen / w.sum(), rtol=0, atol=1e-5)  # 1e-7
    assert noise**2 == pytest.approx((w * ((mean - seen) ** 2).sum(axis=1)).sum() / seen.size, rel=1e-5)
    assert w[-1] < 0.03
    assert np.abs(mean).max() < 1 < seen.mean(axis=0)[0]


@pytest.mark.long
def test_member_by_member_is_the_same_function_with_the_same_derivatives():
    def plain(p, data):
        return jnp.sin(p["a"] * data["t"]) + p["b"][0] * data["t"]

    looped = li.fitting.member_by_member(plain)
    p = {"a": jnp.array([0.3, 0.8]), "b": jnp.array([[1.0, 2.0], [3.0, 4.0]])}
    data = {"t": jnp.linspace(0, 1, 10).reshape(2, 5)}
    np.testing.assert_allclose(jax.vmap(looped)(p, data), jax.vmap(plain)(p, data), rtol=1e-15)
    ours, theirs = (jax.jit(jax.vmap(jax.jacfwd(f)))(p, data) for f in (looped, plain))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15), ours, theirs)
    assert "scan" in str(jax.make_jaxpr(jax.vmap(looped))(p, data))
