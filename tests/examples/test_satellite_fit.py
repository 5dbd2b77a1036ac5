"""The script of the satellite's fit: the kept values, its periods, and a fit from near the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kept_values import assert_lines_are_kept

from lieint_jax.examples import satellite_fit
from lieint_jax.fitting import inference, tumbling

TRUTH = {"attitude": np.zeros(3), "inertia": np.array([650, 1490]) / 1360, "rate": np.array(satellite_fit.RATE)}

pytestmark = pytest.mark.long


def light(t):
    """Magnitudes of the true motion, in closed form."""
    body, state = motion()
    return np.asarray(jax.lax.map(lambda t: satellite_fit.magnitude(body.solution(state, t).q, t), t, batch_size=256))


def motion():
    return tumbling.model(TRUTH, jnp.array(satellite_fit.ATTITUDE))


def test_the_fit_prints_the_values_that_were_kept(capsys, tmp_path):
    satellite_fit.main(guesses=20_000, starts=200, out=tmp_path / "fit.png")
    text = capsys.readouterr().out
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert_lines_are_kept("satellite_fit", text)
    for words in (
        "phase angle 52° to 16° to 51°",
        "0.06011 and 0.13662 per min",
        "leave 10.7 % of the variance",
        "1/16.64 and 1/26.14 per min",
        "-0.00085 and +0.00005",
    ):
        assert words in text, words
    for word in ("Kaasalainen", "Pravec"):
        assert word in text


def test_the_period_search_finds_the_true_pair(capsys):
    """One pair of frequencies is the true one, to half the width of a line."""
    body, state = motion()
    t, true = satellite_fit.exposures(8), 1 / np.asarray(tumbling.mean_periods(body, state))
    observed = light(t) + satellite_fit.NOISE * np.random.default_rng(3).normal(size=len(t))
    candidates = satellite_fit.search_periods(t, observed, true)
    assert np.abs(candidates - true).max(axis=1).min() < 0.5 / t[-1]
    assert "per min, is the true one up to" in capsys.readouterr().out


def test_a_fit_from_near_the_truth_recovers_it():
    """Without noise to what the scheme of order 6 leaves; with noise within four standard errors."""
    _, state = motion()
    t = satellite_fit.exposures(8)
    t = t[t < 145.0]
    clean = light(t)
    noise = satellite_fit.NOISE * np.random.default_rng(4).normal(size=len(t))
    guess = TRUTH | {"attitude": TRUTH["attitude"] + 5.0, "rate": TRUTH["rate"] * 1.005}
    guess, begin = jax.tree.map(lambda x: np.stack([x, x]), (guess, np.array(state.q)))
    asked, data = satellite_fit.problem(t), (begin, np.stack([clean, clean + noise]))
    found = inference.fit_starts(asked, guess, data, tolerance=1e-6, iterations=50).starts
    assert found.success.all()
    np.testing.assert_allclose(found.params["rate"][0], TRUTH["rate"], rtol=0, atol=0.01)
    each = np.concatenate([found.params["inertia"][1] - TRUTH["inertia"], found.params["rate"][1] - TRUTH["rate"]])
    assert (np.abs(each) < 4 * np.sqrt(np.diagonal(found.covariance[1]))[3:]).all()
