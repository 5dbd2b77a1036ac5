"""The engine of inference against scipy: estimates, errors, forecasts, outliers; the fit of the page, and refusals."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from documents import blocks
from scipy.optimize import curve_fit, minimize

import lieint_jax as li
from lieint_jax.fitting import inference

PAGE = Path(__file__).parents[2] / "docs" / "pages" / "howto" / "fit_my_data.md"
TRUTH = (0.02, -0.01, 0.015, 0.6, 0.8, 0.5, 0.3, 0.4)  # of the page's data: biases, ratios, rates


@pytest.mark.long
def test_the_fit_of_the_page_finds_the_truth_within_its_errors(fresh_folder):
    names = {}
    for _, code in blocks(PAGE.read_text(encoding="utf-8"), "python"):
        exec(compile(code, "page", "exec"), names)
    found = names["found"]
    pulls = (found.estimate.values - TRUTH) / found.estimate.sigmas
    assert np.abs(pulls).max() < 3  # observed: 0.8
    assert (pulls**2).sum() < 20  # χ² of 8
    assert found.estimate.sigmas[3] < 0.005


T = np.linspace(0.1, 4, 40)
DECAY = 2.0 * np.exp(-0.7 * T) + 0.05 * np.random.default_rng(3).normal(size=40)


def decay(**changes):
    """The amplitude and rate of a decay, with its half-life."""
    unknowns = {
        "amplitude": inference.Unknown(("amplitude",), 1.0, li.fitting.positive, 0.5),
        "rate": inference.Unknown(("rate (1/s)",), 1.0, li.fitting.positive, 0.5),
    }
    options = {
        "title": "A decay",
        "noise": 0.05,
        "derived": lambda p, _: jnp.log(2.0)[None] / p["rate"],
        "quantities": ("half-life (s)",),
        "published": [inference.Published("half-life (s)", 1.5, 0.1, "a handbook")],
        "t": T,
        "forecast": (np.array([5.0, 10.0]), lambda p: p["amplitude"] * jnp.exp(-p["rate"] * jnp.array([5.0, 10.0]))),
    }
    given = {"unknowns": unknowns, "errors": decay_errors, "data": jnp.asarray(DECAY)}
    return inference.Problem(**(given | options | changes))


def decay_errors(params, data):
    return params["amplitude"] * jnp.exp(-params["rate"] * T) - data


@pytest.mark.long
def test_a_problem_has_the_estimate_the_errors_and_the_forecast_of_scipy():
    """`curve_fit` of the same data; half-life and forecast by propagation of errors."""
    found = inference.infer(decay(), quick=True, progress=False)
    x, C = curve_fit(lambda t, a, k: a * np.exp(-k * t), T, DECAY, (1, 1), np.full(40, 0.05), absolute_sigma=True)
    e, factor = found.estimate, found.factors[0] * found.factors[2]
    np.testing.assert_allclose(e.x, x, rtol=1e-6)
    np.testing.assert_allclose(e.covariance, C * factor**2, rtol=1e-4)
    assert found.share_at_minimum == 1
    assert found.factors.min() >= 1
    assert found.factors.max() < 1.3
    np.testing.assert_allclose(e.values[2], np.log(2) / x[1], rtol=1e-6)
    np.testing.assert_allclose(e.sigmas[2], factor * np.log(2) / x[1] ** 2 * np.sqrt(C[1, 1]), rtol=1e-4)
    t, value, low, high = found.forecast
    np.testing.assert_allclose(value, x[0] * np.exp(-x[1] * t), rtol=1e-6)
    slope = np.stack([value / x[0], -t * value], axis=1)
    sigma = factor * np.sqrt(np.einsum("ti,ij,tj->t", slope, C, slope))
    np.testing.assert_allclose((high - low) / (2 * 1.645 * sigma), 1, rtol=0.25)  # 200 members
    c = found.coverage
    assert c.success.all()
    assert 0.6 < np.sqrt((c.pulls**2).mean()) < 1.4  # 40 pulls of two parameters
    book, pull = found.published[0], (1.5 - e.values[2]) / np.hypot(e.sigmas[2], 0.1)
    assert inference.pull(book.quantity, e.values[2], e.sigmas[2], book.value, book.error) == pytest.approx(pull)
    assert found.tested.shape == (20, 3)  # amplitude, rate, half-life


@pytest.mark.long
def test_outliers_do_not_move_an_estimate_with_student_s_t():
    """The likelihood of Student's t by scipy; the noise level corrected for two parameters of forty numbers."""
    data = DECAY.copy()
    data[[5, 17]] += 3.0
    errors = lambda p, data: decay_errors(p, data)[None, :, None]  # noqa: E731
    simulate = lambda p, data, noise: data + decay_errors(p, data) - noise[0, :, 0]  # noqa: E731
    noise = inference.StudentT((0.1,), 1e-3, 10.0)
    problem = dataclasses.replace(decay(noise=noise), errors=errors, simulate=simulate, data=jnp.asarray(data))
    found = inference.infer(problem, quick=True, progress=False)

    def loss(z):
        square = (z[0] * np.exp(-z[1] * T) - data) ** 2
        return 40 * z[2] + 2.5 * np.log1p(square / 4 * np.exp(-2 * z[2])).sum()

    best = minimize(loss, [2.0, 0.7, np.log(0.05)], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12})
    np.testing.assert_allclose(found.estimate.x, best.x[:2], rtol=1e-5)
    assert found.estimate.noise[0] == pytest.approx(np.exp(best.x[2]) * np.sqrt(40 / 38), rel=1e-4)
    assert (np.abs(found.estimate.x - [2.0, 0.7]) < 3 * found.estimate.sigmas[:2]).all()
    assert found.coverage.pulls.shape == (20, 4)  # amplitude, rate, noise, half-life


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the fit did not converge")
def test_a_fit_without_success_has_a_message_and_no_tested_errors_and_one_without_a_value_is_refused():
    with pytest.warns(RuntimeWarning, match="the fit is no success"):
        found = inference.infer(decay(noise=0.005), quick=True, progress=False)
    assert found.coverage is None
    assert "too small by a factor of" in found.fit.message
    assert found.tested is None
    assert (found.factors == 1).all()
    with pytest.raises(ValueError, match="no start of 'A decay' can be evaluated"):
        inference.infer(decay(errors=lambda p, data: data * jnp.nan), quick=True, progress=False)


def test_a_problem_that_cannot_be_fitted_is_refused_in_a_sentence():
    unknown = inference.Unknown(("amplitude", "phase"), 1.0)
    cases = [
        (lambda: decay(unknowns={"a": unknown}), "needs a name for each of its 1 numbers"),
        (lambda: decay(unknowns={"noise": unknown._replace(names=("noise",))}), "no unknown may be called noise"),
        (lambda: decay(published=[inference.Published("mass", 1.0)]), "is of 'mass', but the names are amplitude"),
        (
            lambda: inference.infer(decay(data=jnp.asarray(DECAY)[:, None]), True, False),
            r"shape \(40, 40\), but the data",
        ),
        (lambda: decay(noise=-0.05), "noise must be a positive standard deviation, got -0.05"),
        (lambda: decay(noise=np.append(np.full(39, 0.05), np.nan)), "noise must be a positive"),
        (lambda: inference.infer(decay(t=T[:3]), True, False), r"times of the 40 rows of errors, got the shape \(3,\)"),
        (
            lambda: inference.infer(decay(quantities=("half-life (s)", "mean life (s)")), True, False),
            r"derived returns the shape \(1,\), but `quantities` has 2 names",
        ),
    ]
    for make, words in cases:
        with pytest.raises(ValueError, match=words):
            make()


def test_random_starts_stay_inside_their_bounds():
    problem = decay()
    wide = problem.unknowns["rate"]._replace(scatter=10.0)
    problem = dataclasses.replace(problem, unknowns={**problem.unknowns, "rate": wide})
    starts = inference.random_starts(problem, 50, 0)
    assert (starts["rate"] > 0).all()
    assert len(set(starts["rate"].tolist())) == 50
