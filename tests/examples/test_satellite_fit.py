"""The script of the satellite's fit: the kept values, its minima, its periods, and a fit from near the truth."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kept_values import assert_lines_are_kept

from lieint_jax.examples import satellite_fit
from lieint_jax.fitting import inference, tumbling

TRUTH = {"attitude": np.zeros(3), "inertia": np.array([650, 1490]) / 1360, "rate": np.array(satellite_fit.RATE)}

pytestmark = pytest.mark.long


def motion():
    return tumbling.model(TRUTH, jnp.array(satellite_fit.ATTITUDE))


def test_the_fit_prints_the_values_that_were_kept(capsys, tmp_path):
    satellite_fit.main(guesses=20_000, starts=200, continued=40, sets=20, out=tmp_path / "fit.png")
    text = capsys.readouterr().out
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert_lines_are_kept("satellite_fit", text)
    for words in (
        "and the truth after a half turn of the body",
        "phase angle 52° to 16° to 51°",
        "0.034 of the noise",
        "(1, 0), (2, 4), (1, 2), (1, 4), (0, 2), (3, 4), (3, 0), (2, 0), (2, 2), (2, -3)",
        "0.06011 and 0.13662 per min",
        "leave 10.7 % of the variance",
        "1/16.64 and 1/26.14 per min",
        "-0.00085 and +0.00005 per min",
        "1.4 higher before the shadow",
        "27.6 higher in the night",
        "1.5 % end at the true motion",
        "68 % within 1σ, 97 % within 2σ, rms/σ 0.96",
        "17 of the 24 named solutions are not minima",
    ):
        assert words in text, words
    for name, early, late in (("mirror", "0.0026", "0.015"), ("exchange", "0.27", "0.66")):
        [effects] = re.findall(rf"^    {name}  +\S+e-1[56] +(\S+) +(\S+)$", text, re.M)
        assert effects == (early, late)
    for word in ("Kaasalainen", "Pravec", "Binz"):
        assert word in text


def test_minima_of_the_light_are_those_of_a_fine_grid():
    body, state = motion()
    t = np.linspace(0, 145, 145_001)
    light = np.asarray(satellite_fit.exact(body, state, t)[1])
    inside = light[1:-1]
    there = t[1:-1][(inside > light[:-2]) & (inside > light[2:])]
    found = satellite_fit.times_of_minima(body, state)
    np.testing.assert_allclose(found, there, rtol=0, atol=2e-3)  # all of them, and no other: the grid's step is 1e-3


def test_the_period_search_finds_the_true_combinations(capsys):
    """All strong sines are combinations, as good as all with an even k; one candidate pair is the true one."""
    body, state = motion()
    t, true = satellite_fit.exposures(8), 1 / np.asarray(tumbling.mean_periods(body, state))
    light = np.asarray(satellite_fit.exact(body, state, t)[1])
    observed = light + satellite_fit.NOISE * np.random.default_rng(3).normal(size=len(t))
    candidates = satellite_fit.search_periods(t, observed, true)
    assert np.abs(candidates - true).max(axis=1).min() < 0.5 / t[-1]
    sines, even = re.search(r"(\d+) of the 10 strongest[\s\S]* (\d+) of them have it", capsys.readouterr().out).groups()
    assert int(sines) >= 9
    assert int(even) >= 9


def test_a_fit_from_near_the_truth_recovers_it():
    """Without noise to what the scheme of order 6 leaves; with noise within four standard errors."""
    body, state = motion()
    t = satellite_fit.exposures(8)
    t = t[t < 145.0]
    clean = np.asarray(satellite_fit.exact(body, state, t)[1])
    noise = satellite_fit.NOISE * np.random.default_rng(4).normal(size=len(t))
    guess = TRUTH | {"attitude": TRUTH["attitude"] + 5.0, "rate": TRUTH["rate"] * 1.005}
    guess, begin = jax.tree.map(lambda x: np.stack([x, x]), (guess, np.array(state.q)))
    asked, data = satellite_fit.problem(t), (begin, np.stack([clean, clean + noise]))
    found = inference.fit_starts(asked, guess, data, **satellite_fit.SEARCH).starts
    assert found.success.all()
    np.testing.assert_allclose(found.params["rate"][0], TRUTH["rate"], rtol=0, atol=0.01)
    each = np.concatenate([found.params["inertia"][1] - TRUTH["inertia"], found.params["rate"][1] - TRUTH["rate"]])
    assert (np.abs(each) < 4 * np.sqrt(np.diagonal(found.covariance[1]))[3:]).all()
