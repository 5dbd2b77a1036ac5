"""The sines of a series and the two frequencies that generate them, from irregular data."""

import itertools

import numpy as np
import pytest

from lieint_jax import measure

TRUE = np.array([0.0613, 0.0771])
LINES = ((1, 0, 1.0), (1, 1, 0.8), (2, 1, 0.5), (0, 1, 0.4), (2, -1, 0.3))
BAND = (0.01, 0.16)


def series():
    """150 irregular times, and a series of five combinations of two frequencies with small noise."""
    rng = np.random.default_rng(6)
    t = np.sort(rng.uniform(0, 400, 150))
    y = sum(a * np.cos(2 * np.pi * (np.array([j, k]) @ TRUE * t) + 3 * a) for j, k, a in LINES)
    return t, y, 0.02 * rng.normal(size=150)


def test_the_sines_are_the_combinations_that_the_series_has():
    t, y, noise = series()
    found = measure.sines(t, y + noise, np.arange(0.005, 0.35, 1 / 2400), 5)
    assert {measure.combination(sine.frequency, TRUE, 3, 1 / 400)[:2] for sine in found} == {line[:2] for line in LINES}
    assert sum(sine.share for sine in found) == pytest.approx(1, abs=0.01)  # 0.9975


@pytest.mark.long
def test_the_two_frequencies_of_a_double_series_are_found():
    t, y, noise = series()
    found = measure.double_periods(t, y + noise, *BAND, separation=0.004)
    best = measure.equivalent_pairs(found.pairs[0], *BAND)
    assert np.abs(best - TRUE).max(axis=1).min() < 2e-4
    assert found.unexplained[0] < 0.05  # 0.017: the grid's nearest frequencies are off by up to 1/8 of 1/400
    exact = measure.double_periods(t, y, 0.0605, 0.0775, separation=0.01, step=1e-4)
    np.testing.assert_allclose(exact.pairs[0], TRUE, rtol=1e-12)
    assert exact.unexplained[0] < 4e-6  # 1e-6, of the ridge


def test_pairs_of_one_peak_are_one_pair():
    t, y, _ = series()
    found = measure.double_periods(t, y, 0.055, 0.085, separation=0.004, count=3)
    assert len(found.pairs) == 3
    for one, other in itertools.combinations(found.pairs, 2):
        assert np.abs(one - other).max() > 0.004
    assert (np.diff(found.unexplained) >= 0).all()


def test_the_chance_of_a_match_is_the_share_of_matching_frequencies():
    """Beside frequencies at random; intervals that overlap count once, and only inside the band."""
    jk, pair, f = measure.combinations(3), np.array([0.061, 0.038]), np.linspace(0.01, 0.3, 20001)
    near = np.abs(jk @ pair - f[:, None]).min(axis=1) < 0.002
    assert measure.chance_of_match(jk @ pair, 0.01, 0.3, 0.002) == pytest.approx(near.mean(), abs=1e-3)


def test_equivalent_pairs_generate_the_same_combinations():
    pair = np.array([0.05, 0.08])
    found = measure.equivalent_pairs(pair, 0.01, 0.2)
    assert any(np.allclose(b, pair) for b in found)
    assert any(np.allclose(b, pair[::-1]) for b in found)
    for basis in found:
        a = np.rint(
            [next(x for x in itertools.product(range(-2, 3), repeat=2) if np.isclose(x @ pair, f)) for f in basis]
        )
        assert abs(np.linalg.det(a)) == pytest.approx(1, rel=1e-14, abs=0)


def test_equivalent_pairs_do_not_depend_on_the_unit_of_time():
    pair, unit = np.array([0.05, 0.0500003]), 2.0**-24
    np.testing.assert_array_equal(
        measure.equivalent_pairs(pair * unit, 0.01 * unit, 0.2 * unit), unit * measure.equivalent_pairs(pair, 0.01, 0.2)
    )


def test_a_band_without_pairs_and_a_nan_are_refused_with_a_sentence():
    t, y, _ = series()
    with pytest.raises(ValueError, match=r"no two frequencies from 0.01 to 0.02, .* differ by 0.1"):
        measure.double_periods(t, y, 0.01, 0.02, separation=0.1)
    y[3] = np.nan
    for find in (lambda: measure.sines(t, y, [0.1], 1), lambda: measure.double_periods(t, y, *BAND, separation=0.004)):
        with pytest.raises(ValueError, match="must be finite"):
            find()
