"""Fits: known minima, known covariances, bounds, many starts, and failures that poison nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lieint_jax import studies

T = jnp.linspace(0, 3, 40)


def decay(p):
    return p["a"] * jnp.exp(-p["k"] * T)


TRUTH = {"a": jnp.array(2.0), "k": jnp.array(0.7)}
DATA = decay(TRUTH)
NOISE = 0.01 * jnp.asarray(np.random.default_rng(0).normal(size=T.size))


def residuals(p):
    return (decay(p) - DATA - NOISE) / 0.01


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "gauss_newton"])
def test_least_squares_finds_what_scipy_finds(optimizer):
    from scipy.optimize import curve_fit

    found = studies.fit(residuals, {"a": 1.0, "k": 0.2}, optimizer, tolerance=1e-14)
    best, covariance = curve_fit(
        lambda t, a, k: a * np.exp(-k * t), np.asarray(T), np.asarray(DATA + NOISE), sigma=np.full(T.size, 0.01),
        absolute_sigma=True, xtol=1e-14, ftol=1e-14,
    )  # fmt: skip
    assert found.success
    np.testing.assert_allclose([found.params["a"], found.params["k"]], best, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5)
    np.testing.assert_allclose(found.standard_errors["k"], np.sqrt(covariance[1, 1]), rtol=1e-5)
    assert np.all(np.diff(found.history) <= 0)


def rosenbrock(p):
    return (1 - p[0]) ** 2 + 100 * (p[1] - p[0] ** 2) ** 2


@pytest.mark.parametrize(("optimizer", "iterations"), [("lbfgs", 60), (optax.adam(0.05), 1500)], ids=["lbfgs", "adam"])
def test_scalar_losses(optimizer, iterations):
    found = studies.fit(rosenbrock, jnp.array([0.5, 0.5]), optimizer, iterations=iterations)
    np.testing.assert_allclose(found.params, [1, 1], atol=5e-3)
    assert found.covariance is None
    with pytest.raises(ValueError, match="least-squares"):
        _ = found.standard_errors


@pytest.mark.parametrize(
    "optimizer",
    [
        "levenberg_marquardt",
        "gauss_newton",
        pytest.param("lbfgs", marks=pytest.mark.long),
        optax.adam(0.3),
        optax.sgd(5.0),
    ],
)
def test_a_failed_trial_never_poisons_the_fit(optimizer):
    """The minimum at 1 lies beside a region where the solve fails, one time with nan, one time with its flag down."""

    def loss(x):
        return (x - 1) ** 2

    for wall in (lambda x: (jnp.where(x > 1.05, jnp.nan, loss(x)), True), lambda x: (loss(x), x <= 1.05)):
        if isinstance(optimizer, str) and optimizer != "lbfgs":
            squared = lambda x, wall=wall: (jnp.sqrt(2 * wall(x)[0] + 1e-3), wall(x)[1])  # noqa: E731
        else:
            squared = wall
        found = studies.fit(squared, jnp.array(-3.0), optimizer, iterations=300)
        assert float(found.params) <= 1.05
        assert abs(found.params - 1) < 0.06
        assert np.isfinite(found.history).all()
        if not isinstance(optimizer, str):
            assert found.failures > 0


def test_a_first_guess_that_fails_is_reported():
    found = studies.fit(lambda x: jnp.sqrt(x), jnp.array([-1.0]), "levenberg_marquardt")
    assert not found.success
    assert found.stopped == "the first guess failed"
    assert found.params[0] == -1


def test_many_starts_at_once_and_the_best_is_taken():
    def loss(x):
        return jnp.array([jnp.sin(3 * x) + 0.2 * x**2 + 0.1 * x + 2])  # minima of different depths

    starts = jnp.linspace(-3.0, 3.0, 9)
    found = studies.fit(loss, starts, starts=True)
    alone = [studies.fit(loss, s) for s in (starts[0], starts[5])]
    assert found.loss == min(found.starts.loss)
    np.testing.assert_allclose(found.starts.params[jnp.array([0, 5])], [a.params for a in alone], atol=1e-6)
    assert float(found.params) == pytest.approx(-0.53, abs=0.05)


def test_each_start_may_have_data_of_its_own():
    def loss(p, data):
        return p - data

    found = studies.fit(loss, jnp.zeros(3), starts=True, data=jnp.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found.starts.params, [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(found.starts.covariance, np.ones((3, 1, 1)))
    assert found.starts.success.all()


def test_stopping_rules():
    far = studies.fit(rosenbrock, jnp.array([-1.0, 1.0]), "lbfgs", iterations=3)
    assert (far.iterations, far.success, len(far.history)) == (3, False, 4)
    assert studies.fit(rosenbrock, jnp.array([-1.0, 1.0]), "lbfgs", target=1.0).stopped == "the target was reached"
    assert studies.fit(residuals, TRUTH, target=1e6).iterations == 0


BOUNDS = {
    "positive": (studies.positive, jnp.array([0.3, 2.0])),
    "interval": (studies.interval(-1.0, 2.0), jnp.array([-0.9, 1.5])),
    "principal": (studies.principal_inertia, jnp.array([1.0, 2.0, 2.9])),
    "spd": (studies.spd, jnp.array([[2.0, 0.3, -0.1], [0.3, 1.0, 0.2], [-0.1, 0.2, 3.0]])),
    "inertia": (studies.inertia, jnp.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 2.9]])),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_are_inverse_maps_onto_their_domain(name):
    bound, inside = BOUNDS[name]
    np.testing.assert_allclose(bound.inside(bound.free(inside)), inside, rtol=1e-14, atol=1e-15)
    x = 4 * jax.random.normal(jax.random.key(0), (20, *bound.free(inside).shape))
    values = np.asarray(jax.vmap(bound.inside)(x))
    assert np.isfinite(values).all()
    if name == "interval":
        assert ((values > -1) & (values < 2)).all()
        return
    moments = np.linalg.eigvalsh(values) if values.ndim == 3 else np.sort(values)
    assert (moments > -1e-12 * moments.max(axis=1, keepdims=True)).all()
    if name in ("principal", "inertia"):
        assert (moments[:, 2] <= (1 + 1e-12) * (moments[:, 0] + moments[:, 1])).all()


def test_a_bounded_fit_stays_inside_and_a_guess_outside_is_refused():
    def loss(p):
        return {"a": p["a"] + 1, "b": p["b"] - 3}  # the minimum of a is at −1, outside

    bounds = {"a": studies.positive, "b": studies.free}
    found = studies.fit(loss, {"a": 1.0, "b": 0.0}, bounds=bounds, iterations=30)
    assert 0 <= found.params["a"] < 1e-3
    np.testing.assert_allclose(found.params["b"], 3, atol=1e-6)
    with pytest.raises(ValueError, match="not inside its bound, positive"):
        studies.fit(loss, {"a": -1.0, "b": 0.0}, bounds=bounds)


def test_covariance_does_not_depend_on_the_bound():
    plain = studies.fit(residuals, TRUTH)
    bounded = studies.fit(residuals, TRUTH, bounds=studies.positive)
    np.testing.assert_allclose(bounded.covariance, plain.covariance, rtol=1e-5)
    np.testing.assert_allclose(studies.covariance(residuals, plain.params), plain.covariance, rtol=1e-12)


def test_errors():
    with pytest.raises(ValueError, match="optimizer must be"):
        studies.fit(rosenbrock, jnp.zeros(2), "newton")
    with pytest.raises(ValueError, match="must be a scalar"):
        studies.fit(residuals, TRUTH, "lbfgs")
    with pytest.raises(ValueError, match="made of Bound"):
        studies.fit(residuals, TRUTH, bounds="positive")
