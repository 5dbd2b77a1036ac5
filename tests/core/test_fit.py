"""Fits: known minima, known covariances, bounds, many starts, and failures that poison nothing."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import lieint_jax as li
from lieint_jax.fitting import _trust_region
from lieint_jax.fitting._least_squares import spread

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore:the fit did not converge")]
T = np.linspace(0, 3, 40)


def decay(p):
    return p["a"] * jnp.exp(-p["k"] * T)


TRUTH = {"a": jnp.array(2.0), "k": jnp.array(0.7)}
DATA = 2.0 * np.exp(-0.7 * T)
NOISE = 0.01 * np.random.default_rng(0).normal(size=T.size)


def residuals(p):
    return (decay(p) - DATA - NOISE) / 0.01


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "gauss_newton", "scipy"])
def test_least_squares_finds_what_scipy_finds(optimizer):
    from scipy.optimize import curve_fit

    found = li.fit(residuals, {"a": 1.0, "k": 0.2}, optimizer, tolerance=1e-14)
    best, covariance = curve_fit(
        lambda t, a, k: a * np.exp(-k * t), np.asarray(T), np.asarray(DATA + NOISE), sigma=np.full(T.size, 0.01),
        absolute_sigma=True, xtol=1e-14, ftol=1e-14,
    )  # fmt: skip
    assert found.success
    np.testing.assert_allclose([found.params["a"], found.params["k"]], best, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5)
    np.testing.assert_allclose(found.standard_errors["k"], np.sqrt(covariance[1, 1]), rtol=1e-5)
    assert np.all(np.diff(found.history) <= 0)


U = np.arange(1.0, 16.0)
BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.1, 4.39])
MEYER = [34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
# Moré, Garbow & Hillstrom 1981, ACM Trans. Math. Softw. 7: residuals, start, least sum of squares.
PUBLISHED = {
    "powell_singular": (
        lambda x: jnp.stack(
            [x[0] + 10 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2]
        ),
        [3.0, -1.0, 0.0, 1.0],
        0.0,
    ),
    "freudenstein_roth": (
        lambda x: jnp.stack(
            [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]
        ),
        [0.5, -2.0],
        48.9842,
    ),
    "bard": (lambda x: BARD - x[0] - U / ((16 - U) * x[1] + np.minimum(U, 16 - U) * x[2]), [1.0, 1.0, 1.0], 8.21487e-3),
    "meyer": (
        lambda x: x[0] * jnp.exp(x[1] / (45 + 5 * jnp.arange(1.0, 17.0) + x[2])) - jnp.array(MEYER),
        [0.02, 4000.0, 250.0],
        87.9458,
    ),
    "brown_badly_scaled": (lambda x: jnp.stack([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2]), [1.0, 1.0], 0.0),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_levenberg_marquardt_needs_as_many_evaluations_as_minpack(name):
    from scipy.optimize import least_squares

    function, start, least = PUBLISHED[name]
    found = li.fit(function, jnp.array(start), iterations=300)
    both = jax.jit(lambda x: (function(x), jax.jacfwd(function)(x)))
    theirs = least_squares(
        lambda x: np.asarray(both(x)[0]), start, jac=lambda x: np.asarray(both(x)[1]), method="lm",
        x_scale="jac", xtol=1e-10, ftol=1e-10, gtol=1e-10, max_nfev=1000,
    )  # fmt: skip
    assert found.success
    assert 2 * found.loss == pytest.approx(least, rel=1e-5, abs=1e-20)
    assert found.loss <= theirs.cost + 1e-10 * (1 + theirs.cost)
    assert found.iterations + 1 <= 1.8 * theirs.nfev  # 0.75 to 1.7


def test_what_the_residuals_do_not_determine_has_an_infinite_variance():
    found = li.fit(lambda x: jnp.array([x[0] + x[1] - 3, x[2] - 1, 2 * x[2] - 2]), jnp.zeros(3))
    assert found.success
    np.testing.assert_allclose(found.params, [1.5, 1.5, 1], rtol=0, atol=1e-12)  # of all least ones the nearest
    C = found.covariance
    np.testing.assert_allclose(np.diagonal(C), [np.inf, np.inf, 0.2], rtol=5e-15)
    assert np.isnan(C[0, 1])
    fewer = li.fit(lambda x: x[:1] - 1, jnp.zeros(2), "gauss_newton")
    np.testing.assert_allclose(np.diagonal(fewer.covariance), [1, np.inf], rtol=5e-15)


WALL = 2.0  # the least is behind a wall at 1
CASES = {
    "gauss_newton": (lambda x: (WALL - x, x[0] < 1), "gauss_newton"),
    "levenberg_marquardt": (lambda x: (WALL - x, x[0] < 1), "levenberg_marquardt"),
    "lbfgs": (lambda x: (jnp.sum((WALL - x) ** 2), x[0] < 1), "lbfgs"),
    "adam": (lambda x: (jnp.sum((WALL - x) ** 2), x[0] < 1), optax.adam(0.1)),
    "short steps": (lambda x: jnp.sum((WALL - x) ** 2), optax.sgd(1e-12)),
}


@pytest.mark.parametrize("name", CASES)
def test_no_success_where_the_gradient_has_not_vanished(name):
    loss, optimizer = CASES[name]
    found = li.fit(loss, jnp.array([0.5]), optimizer, iterations=200)
    assert not found.success
    assert found.params[0] <= 1


def test_the_unit_of_a_loss_does_not_matter():
    for unit, dtype in ((1e-12, jnp.float64), (1e-9, jnp.float32)):
        found = li.fit(lambda x, u=unit: u * jnp.sum((x - 0.3) ** 4), jnp.ones(2, dtype), "lbfgs")
        assert found.success
        np.testing.assert_allclose(found.params, 0.3, rtol=0, atol=2e-3 if dtype == jnp.float64 else 1e-2)


def test_the_units_of_parameters_do_not_decide_when_the_gradient_has_vanished():
    """In float64 and 1e-20, 1e20 and 1: the gradient by the first is 1e40 times that by the second."""
    unit, truth = np.array([1e-20, 1e20, 1.0]), np.array([3.0, 2.0, 0.5])
    t = np.linspace(0, 1, 9)

    def loss(p, exp=jnp.exp):
        a, k, c = jnp.asarray(p) / unit
        return jnp.sum((a * exp(-k * t) + c - truth[0] * np.exp(-truth[1] * t) - truth[2]) ** 2)

    for bounds in (li.fitting.positive, [li.fitting.interval(0, 10 * u) for u in unit]):
        found = li.fit(loss, list(np.array([2.0, 1.0, 0.3]) * unit), "lbfgs", bounds=bounds, iterations=300)
        assert found.success
        np.testing.assert_allclose(found.params / unit, truth, rtol=1e-5)  # 2e-7


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "gauss_newton", "scipy"])
def test_squares_of_derivatives_may_leave_the_range_of_float32(optimizer):
    """Derivatives of 1e25 and 1e-20, whose squares are infinite and 0. The variance 1e-51 is no number in float32."""
    unit = np.array([1e20, 1.0, 1e-25], np.float32)
    found = li.fit(lambda p: A32 @ (p / unit) - A32 @ np.arange(1, 4, dtype=np.float32), 5 * unit, optimizer)
    assert found.success
    np.testing.assert_allclose(found.params / unit, [1, 2, 3], rtol=2e-6)
    variances = np.diagonal(np.linalg.inv(A32.T.astype(float) @ A32))
    np.testing.assert_allclose(np.diagonal(found.covariance)[1:], [variances[1], np.nan], rtol=1e-5)


def test_the_best_parameters_of_the_search_are_returned():
    found = li.fit(lambda x: jnp.sum((x - 0.3) ** 2), jnp.ones(2), optax.adam(1.0), iterations=11)
    assert found.loss == found.history.min() < found.history[-1]


def test_a_pair_of_residuals_is_no_value_with_a_flag():
    found = li.fit(lambda x: (x - 1, x - 3), jnp.array(0.0))
    assert float(found.params) == pytest.approx(2, rel=1e-14, abs=0)
    assert not li.fit(lambda x: (x - 1, x > 5), jnp.array(0.0)).success  # a flag, and it is down


def rosenbrock(p):
    return (1 - p[0]) ** 2 + 100 * (p[1] - p[0] ** 2) ** 2


@pytest.mark.parametrize(("optimizer", "iterations"), [("lbfgs", 60), (optax.adam(0.05), 1500)], ids=["lbfgs", "adam"])
def test_scalar_losses_are_minimized_without_a_covariance(optimizer, iterations):
    found = li.fit(rosenbrock, jnp.array([0.5, 0.5]), optimizer, iterations=iterations)
    np.testing.assert_allclose(found.params, [1, 1], rtol=0, atol=5e-3)
    assert found.covariance is None
    with pytest.raises(ValueError, match="least-squares"):
        _ = found.standard_errors


@pytest.mark.parametrize(
    "optimizer", ["levenberg_marquardt", "gauss_newton", "scipy", "lbfgs", optax.adam(0.3), optax.sgd(5.0)]
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
        found = li.fit(squared, jnp.array(-3.0), optimizer, iterations=300)
        assert float(found.params) <= 1.05
        assert abs(found.params - 1) < 0.06
        assert np.isfinite(found.history).all()
        assert optimizer != "scipy" or found.success
        if not isinstance(optimizer, str):
            assert found.failures > 0


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "gauss_newton", "scipy"])
def test_a_search_that_ends_where_trials_fail_is_no_success(optimizer):
    """The minimum at 3 lies in the region of failure: steps toward it become as short as the tolerance."""
    found = li.fit(lambda x: (jnp.array([x - 3, x * x - 9]), x < 2.9), 0.5, optimizer, iterations=60)
    assert not found.success
    assert np.isnan(found.covariance).all()


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "scipy"])
def test_a_first_guess_that_fails_is_reported(optimizer):
    found = li.fit(lambda x: jnp.sqrt(x), jnp.array([-1.0]), optimizer)
    assert not found.success
    assert found.stopped == "the first guess failed"
    assert found.params[0] == -1


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "scipy", "lbfgs"])
def test_what_is_not_finite_at_the_first_guess_is_named(optimizer):
    data = {"t": T, "y": np.where(np.arange(T.size) == 3, np.inf, DATA)}

    def fitted(loss, guess=(1.0, 0.2), **options):
        total = (lambda *given: jnp.sum(loss(*given) ** 2)) if optimizer == "lbfgs" else loss
        return li.fit(total, jnp.array(guess), optimizer, **options).message

    def of_data(p, data):
        return p[0] * jnp.exp(-p[1] * data["t"]) - data["y"]

    what = "the loss is inf" if optimizer == "lbfgs" else "residuals[3] is -inf"
    assert "first guess failed: data['y'][3] is inf; start where" in fitted(of_data, data=data)
    assert f"first guess failed: {what}; start where" in fitted(lambda p: of_data(p, data))
    assert "first guess failed: a derivative is not finite" in fitted(lambda p: jnp.sqrt(jnp.abs(p)), (0.0, 1.0))
    if optimizer == "levenberg_marquardt":
        assert "failed: its solves do not converge; start" in fitted(lambda p: (p, jnp.array(False)))
        several = {"starts": True, "data": jax.tree.map(lambda x: np.stack([x, x]), data)}
        assert "data['y'][3] is inf; start where" in fitted(of_data, ((1.0, 0.2), (2.0, 0.3)), **several)


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "gauss_newton", "scipy"])
@pytest.mark.parametrize("size", [1e-170, 1e170])
def test_residuals_whose_squares_are_no_numbers_are_no_success(optimizer, size):
    found = li.fit(lambda p: size * residuals(p), {"a": 1.0, "k": 0.2}, optimizer)
    assert not found.success
    assert found.covariance is None
    assert found.message == (
        "the sum of squares at the first guess leaves the range of floating-point numbers: divide the residuals by "
        "their standard deviation"
    )
    assert li.fit(lambda p: 0 * residuals(p), {"a": 1.0, "k": 0.2}, optimizer).loss == 0  # which is a number


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-8, 1e-100, 1e100])
@pytest.mark.parametrize("optimizer", ["scipy", "levenberg_marquardt", "gauss_newton"])
def test_the_unit_of_residuals_and_parameters_does_not_matter(optimizer, size):
    """Scipy itself stops at the first guess where the gradient is below 1e-10."""
    ours = li.fit(residuals, {"a": 1.0, "k": 0.2}, "gauss_newton", tolerance=1e-14)
    found = li.fit(
        lambda p: size * residuals({"a": p["a"] / 1e-20, "k": p["k"] / 1e20}), {"a": 1e-20, "k": 0.2e20}, optimizer
    )
    assert found.success
    both = [[float(x["a"]) * u, float(x["k"]) / u] for x, u in ((found.params, 1e20), (ours.params, 1.0))]
    np.testing.assert_allclose(*both, rtol=1e-6)  # 1e-8; the standard errors are 1e-3
    errors = found.standard_errors["a"] * 1e20 * size, found.standard_errors["k"] / 1e20 * size
    np.testing.assert_allclose(errors, list(ours.standard_errors.values()), rtol=1e-5)


def test_many_starts_are_fitted_at_once_and_the_best_is_returned():
    def loss(x):
        return jnp.array([jnp.sin(3 * x) + 0.2 * x**2 + 0.1 * x + 2])  # minima of different depths

    starts = jnp.linspace(-3.0, 3.0, 9)
    found = li.fit(loss, starts, starts=True)
    alone = [li.fit(loss, s) for s in (starts[0], starts[5])]
    assert found.loss == min(found.starts.loss)
    np.testing.assert_allclose(found.starts.params[jnp.array([0, 5])], [a.params for a in alone], rtol=0, atol=1e-6)
    assert float(found.params) == pytest.approx(-0.53, abs=0.05)


@pytest.mark.quick
def test_each_start_may_have_data_of_its_own():
    def loss(p, data):
        return jnp.stack([p - data, data])

    found = li.fit(loss, jnp.zeros(3), starts=True, data=jnp.array([2.0, 1.0, 30.0]), standardized=True)
    np.testing.assert_allclose(found.starts.params, [2, 1, 30], rtol=0, atol=1e-9)
    assert (found.params, found.loss, found.message) == (found.starts.params[1], 0.5, "")  # the best
    assert list(found.starts.success) == [True, True, False]  # χ² = 4, 1, 900 of 1 degree of freedom
    np.testing.assert_allclose(found.starts.covariance, [[[1]], [[1]], [[np.nan]]], rtol=1e-14)
    np.testing.assert_allclose(found.starts.standard_errors, [1, 1, np.nan], rtol=1e-14)
    alone = li.fit(lambda p: loss(p, 1.0), jnp.zeros(()), standardized=True)
    assert (found.starts.iterations[1], found.starts.stopped[1]) == (alone.iterations, alone.stopped)
    assert found.starts.failures.tolist() == [0, 0, 0]
    assert found.starts.messages[:2] == ("", "")
    assert "χ² = 900 is implausible for 1 degrees of freedom" in found.starts.messages[2]
    assert [line.split()[:3] for line in repr(found.starts).splitlines()] == [
        ["start", "loss", "success"],
        ["1", "0.5", "yes"],
        ["0", "2", "yes"],
        ["2", "450", "no"],
    ]


def test_scipy_keeps_to_bounds_trials_and_one_start():
    bounds = {"a": li.fitting.interval(0.5, 1.9), "k": li.fitting.positive}
    ours, theirs = (
        li.fit(residuals, {"a": 1.0, "k": 0.2}, name, bounds=bounds) for name in ("levenberg_marquardt", "scipy")
    )
    assert theirs.success
    assert theirs.at_bound
    np.testing.assert_allclose(theirs.params["k"], ours.params["k"], rtol=1e-6)
    np.testing.assert_allclose(theirs.standard_errors["k"], ours.standard_errors["k"], rtol=1e-5)
    few = li.fit(residuals, {"a": 1.0, "k": 0.2}, "scipy", iterations=3)
    assert (few.success, few.stopped, few.iterations) == (False, "the iterations were used up", 2)
    assert li.fit(residuals, TRUTH, "scipy", target=1e6).stopped == "the target was reached"
    with pytest.raises(ValueError, match="fits one start"):
        li.fit(residuals, {"a": np.ones(2), "k": np.ones(2)}, "scipy", starts=True)


def test_a_fit_stops_at_its_target_and_at_its_number_of_iterations():
    far = li.fit(rosenbrock, jnp.array([-1.0, 1.0]), "lbfgs", iterations=3)
    assert (far.iterations, far.success, len(far.history)) == (3, False, 4)
    assert li.fit(rosenbrock, jnp.array([-1.0, 1.0]), "lbfgs", target=1.0).stopped == "the target was reached"
    assert li.fit(residuals, TRUTH, target=1e6).iterations == 0


BOUNDS = {
    "positive": (li.fitting.positive, jnp.array([0.3, 2.0])),
    "interval": (li.fitting.interval(-1.0, 2.0), jnp.array([-0.9, 1.5])),
    "principal": (li.fitting.principal_inertia, jnp.array([1.0, 2.0, 2.9])),
    "ratios": (li.fitting.inertia_ratios, jnp.array([0.45, 0.82])),
    "spd": (li.fitting.spd, jnp.array([[2.0, 0.3, -0.1], [0.3, 1.0, 0.2], [-0.1, 0.2, 3.0]])),
    "inertia": (li.fitting.inertia, jnp.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 2.9]])),
}


@pytest.mark.quick
@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_are_inverse_maps_onto_their_domain(name):
    bound, inside = BOUNDS[name]
    free, again = jax.jit(lambda y: (bound.free(y), bound.inside(bound.free(y))))(inside)
    np.testing.assert_allclose(again, inside, rtol=1e-14, atol=1e-15)
    x = 4 * np.random.default_rng(0).normal(size=(20, *free.shape))
    values = np.asarray(jax.jit(jax.vmap(bound.inside))(x))
    assert np.isfinite(values).all()
    if name == "interval":
        assert ((values > -1) & (values < 2)).all()
        return
    if name == "ratios":
        values = np.column_stack([values, np.ones(len(values))])  # to the third moment
    moments = np.linalg.eigvalsh(values) if values.ndim == 3 else np.sort(values)
    assert (moments > -1e-12 * moments.max(axis=1, keepdims=True)).all()
    if name in ("principal", "ratios", "inertia"):
        assert (moments[:, 2] <= (1 + 1e-12) * (moments[:, 0] + moments[:, 1])).all()


def test_a_bounded_fit_stays_inside_and_a_guess_outside_is_refused():
    def loss(p):
        return {"a": p["a"] + 1, "b": p["b"] - 3}  # the minimum of a is at −1, outside

    bounds = {"a": li.fitting.positive, "b": li.fitting.free}
    found = li.fit(loss, {"a": 1.0, "b": 0.0}, bounds=bounds, iterations=30)
    assert 0 <= found.params["a"] < 1e-3
    assert found.at_bound
    assert "at a bound" in str(found)
    np.testing.assert_allclose(found.params["b"], 3, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="not inside its bound, positive"):
        li.fit(loss, {"a": -1.0, "b": 0.0}, bounds=bounds)


@pytest.mark.parametrize(
    ("bound", "edge", "condition", "inside"),
    [
        (li.fitting.inertia_ratios, [0.9, 0.1], r"J₁ \+ J₂ > 1 > \|J₁ − J₂\|, strictly", [0.9 / 0.999, 0.1 / 0.999]),
        (li.fitting.inertia_ratios, [1.1, 0.1], r"J₁ \+ J₂ > 1 > \|J₁ − J₂\|, strictly", [1.1 * 0.999, 0.1]),
        (li.fitting.principal_inertia, [1.0, 2.0, 3.0], "less than the sum of the two others", [1.0, 2.0, 3.0 * 0.999]),
        (li.fitting.inertia, np.diag([1.0, 2.0, 3.0]), "less than the sum", np.diag([1.0, 2.0, 3.0 * 0.999])),
    ],
)
def test_a_guess_on_the_edge_of_a_bound_is_refused_with_its_condition_and_a_cure(bound, edge, condition, inside):
    def loss(p):
        return p - jnp.asarray(inside)

    with pytest.raises(ValueError, match=f"not inside its bound, .*{condition}.*a plate or a phone.*0.1 % smaller"):
        li.fit(loss, jnp.array(edge), bounds=bound)
    assert li.fit(loss, jnp.array(inside), bounds=bound, iterations=2).success


@pytest.mark.quick
def test_the_covariance_is_that_of_the_parameters_not_of_their_coordinates():
    """B (JᵀJ)⁻¹ Bᵀ, with J by the coordinates and B the derivative of the parameters by them."""
    J, B = np.random.default_rng(3).normal(size=(5, 2)), np.array([[2.0, 0.3], [0.0, 0.5]])
    covariance, rank = jax.jit(spread)(J, B, np.zeros(2, bool))
    np.testing.assert_allclose(covariance, B @ np.linalg.inv(J.T @ J) @ B.T, rtol=1e-12)
    assert rank == 2


A = np.array([[1.0, 0.2], [0.3, 2.0], [0.5, -0.4]])
A32 = np.random.default_rng(4).normal(size=(6, 3)).astype(np.float32)


def test_a_bound_changes_neither_steps_nor_covariance_where_it_is_not_active():
    """A linear problem in coordinates that are no parameters: the covariance is (AᵀA)⁻¹."""
    found = li.fit(lambda p: A @ p - A @ np.array([0.5, 0.7]), jnp.array([0.6, 0.8]), bounds=li.fitting.inertia_ratios)
    assert found.success
    assert (found.at_bound, found.message, found.degrees_of_freedom) == (False, "", 1)
    np.testing.assert_allclose(found.params, [0.5, 0.7], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(A.T @ A), rtol=1e-12)


def test_a_parameter_at_its_bound_has_no_standard_error_and_the_others_are_those_of_a_fit_without_it():
    bounds = {"a": li.fitting.positive, "k": li.fitting.interval(0.1, 0.6)}
    found = li.fit(residuals, {"a": 1.0, "k": 0.2}, bounds=bounds)
    assert found.success
    assert found.at_bound
    assert found.iterations <= 9  # 8; by the logistic map 22
    assert float(found.params["k"]) == pytest.approx(0.6, abs=1e-7)
    shape = np.exp(-0.6 * T)
    assert float(found.params["a"]) == pytest.approx(shape @ (DATA + NOISE) / (shape @ shape), rel=1e-6)
    assert float(found.standard_errors["a"]) == pytest.approx(0.01 / np.linalg.norm(shape), rel=1e-6)
    assert np.isnan(found.standard_errors["k"])
    assert found.message == "k at a bound: it has no standard error"
    assert str(found).splitlines()[2].startswith("  k = 0.6 ± nan")


@pytest.mark.filterwarnings("ignore:the fit is no success")
def test_an_implausible_chi_square_is_no_success():
    """Of residuals that are standardized: 40 of them, with ten times the noise."""
    large = li.fit(lambda p: 10 * residuals(p), TRUTH, standardized=True)
    assert not large.success
    assert np.isnan(large.covariance).all()
    assert large.chi_square > 50 * large.degrees_of_freedom == 50 * 38
    assert "is implausible for 38 degrees of freedom: fit from several guesses with starts=True" in large.message
    with pytest.raises(ValueError, match="standardized=True needs residuals"):
        li.fit(rosenbrock, jnp.zeros(2), "lbfgs", standardized=True)


def test_a_search_that_ends_at_a_bound_with_the_loss_falling_inwards_is_no_success():
    """Steps of gradient descent through the logistic map are nothing there."""
    found = li.fit(lambda p: (p - 0.5) ** 2, 1 - 1e-9, optax.sgd(1.0), bounds=li.fitting.interval(0.0, 1.0))
    assert not found.success
    assert "starts=True" in found.message
    outside = li.fit(lambda p: (p + 0.5) ** 2, 0.5, "lbfgs", bounds=li.fitting.interval(0.0, 1.0))
    assert outside.success
    assert outside.at_bound
    assert 0 < outside.params < 1e-6


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_step_in_a_box_is_that_of_bounded_least_squares(side):
    """20 random problems, with a trust region that does not matter; sides that are near hold some coordinates."""
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(0)
    J, r = rng.normal(size=(20, 7, 4)), rng.normal(size=(20, 7))
    low, high = -rng.uniform(0.01, 0.4, (20, 4)), rng.uniform(0.01, 0.4, (20, 4))
    r = r * side
    step = jax.jit(jax.vmap(lambda *a: _trust_region.bounded_step(a[0], a[1], jnp.asarray(jnp.inf), *a[2:])))
    z, fall, _ = step(J, r, low, high)
    for k in range(20):
        best = lsq_linear(J[k], -r[k], (low[k], high[k]), method="bvls", tol=1e-14)
        np.testing.assert_allclose(z[k], best.x, rtol=0, atol=1e-12)
        assert float(fall[k]) == pytest.approx(r[k] @ r[k] / 2 - best.cost, rel=1e-10, abs=0)


def test_a_loss_is_traced_again_for_other_shapes_only(caplog):
    log, traced = logging.getLogger("traced"), caplog.records  # a list would be read, and changes

    def misfits(p, data):
        log.warning("traced")
        return p["a"] * jnp.exp(-p["k"] * jnp.arange(data.size) / 10) - data

    def fitted(size, a=2.0, **options):
        data = jnp.asarray(a * np.exp(-0.07 * np.arange(size)))
        bounds = {"a": li.fitting.positive, "k": li.fitting.interval(0.1, 3.0)}
        found = li.fit(misfits, {"a": 1.0, "k": 0.2}, bounds=bounds, data=data, progress=False, **options)
        assert found.success
        np.testing.assert_allclose([found.params["a"], found.params["k"]], [a, 0.7], rtol=1e-7)

    fitted(20)
    once = len(traced)
    fitted(20)
    fitted(20, a=1.5)
    assert len(traced) == once > 0
    fitted(25)
    assert len(traced) == 2 * once
    fitted(20, tolerance=1e-9)
    assert len(traced) == 3 * once


@pytest.mark.quick
def test_a_fit_within_any_bound_is_compiled_once(caplog):
    """`inertia_ratios`, `inertia` and `spd` held arrays, which cannot be compared with those of an earlier fit."""
    assert all(isinstance(hash(getattr(li.fitting, name)), int) for name in ("inertia", "spd", "principal_inertia"))
    log = logging.getLogger("traced")  # a list would be read, and changes

    def misfits(p):
        log.warning("traced")
        return p - jnp.array([0.7, 0.8])

    counts = []
    for guess in ([0.6, 0.9], [0.9, 0.9]):
        found = li.fit(misfits, jnp.array(guess), bounds=li.fitting.inertia_ratios, progress=False)
        np.testing.assert_allclose(found.params, [0.7, 0.8], rtol=1e-8)
        counts.append(len(caplog.records))
    assert counts[0] == counts[1] > 0


def test_covariance_does_not_depend_on_the_bound():
    plain = li.fit(residuals, TRUTH)
    bounded = li.fit(residuals, TRUTH, bounds=li.fitting.positive)
    np.testing.assert_allclose(bounded.covariance, plain.covariance, rtol=1e-5)
    np.testing.assert_allclose(li.fitting.covariance(residuals, plain.params), plain.covariance, rtol=1e-12)


def test_observations_at_irregular_times_are_fitted_as_first_written():
    """`ReversibleAdjoint` has its own reverse mode and no forward mode: fit uses it; so does `covariance`."""
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    step, t = li.schemes.so3_midpoint(body), jnp.array([0.7, 1.9, 3.3, 6.1])

    def observed(w):
        start = body.state(angular_velocity=w)
        return li.integrate(step, start, 0.05, save_at=t, adjoint=li.ReversibleAdjoint()).state.q[1:]

    truth = jnp.array([0.2, 0.1, 1.0])
    data = observed(truth)
    found = li.fit(lambda w: (observed(w) - data).ravel(), jnp.array([0.25, 0.05, 1.05]), progress=False)
    assert found.success
    np.testing.assert_allclose(found.params, truth, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        li.fitting.covariance(lambda w: (observed(w) - data).ravel(), found.params), found.covariance
    )


def test_a_fit_that_did_not_converge_has_no_standard_errors():
    def loss(p):
        return jnp.stack([10 * (p["y"][0] - p["x"] ** 2), 1 - p["x"]])

    start = {"x": jnp.array(-1.2), "y": jnp.array([1.0])}
    with pytest.warns(RuntimeWarning, match="did not converge .*iterations were used up.* no standard errors"):
        short = li.fit(loss, start, iterations=2, progress=False)
    assert np.isnan(short.covariance).all()
    assert "x = " in str(short)
    assert "± nan" in str(short)
    full = li.fit(loss, start, progress=False)
    lines = str(full).splitlines()
    assert "the gradient vanished" in lines[0] or "no longer fell" in lines[0]
    assert lines[1:] == ["  x = 1 ± 1", "  y[0] = 1 ± 2"]
