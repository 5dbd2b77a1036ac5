"""Angles as series, thresholds, spectra and periodograms, against series that are known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lombscargle

from lieint_jax import measure

T = np.linspace(0.0, 50.0, 401)
RATES = st.floats(-40.0, 40.0)


def wrapped(angle):
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


@given(RATES, st.floats(0.0, 0.9), st.floats(-np.pi, np.pi))
def test_an_angle_near_its_rate_is_continued_over_any_number_of_revolutions(rate, swing, phase):
    """Also a spin of up to 0.8 revolutions between two saves; the swing deviates by less than π."""
    angle = np.stack([rate * T + swing * np.sin(2 * T + phase) + phase, rate * T], axis=1)
    found = measure.unwrapped(T, wrapped(angle), np.full(2, rate))
    np.testing.assert_allclose(found - found[0], angle - angle[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(wrapped(found - angle), 0, rtol=0, atol=1e-11)


def test_the_mean_rate_of_a_line_is_its_slope_and_a_swing_fades():
    angle = np.stack([0.3 - 1.7 * T, 2.0 * T + 0.5 * np.sin(3 * T)], axis=1)
    found = measure.mean_rate(T, np.stack([angle, angle], axis=-1))
    assert found.shape == (2, 2)
    np.testing.assert_allclose(found[0], -1.7, rtol=1e-14)
    np.testing.assert_allclose(found[1], 2.0, rtol=0, atol=12 * 0.5 / 3 / 50**2)
    slope = jax.grad(lambda x: measure.mean_rate(jnp.asarray(T), x * jnp.asarray(T) ** 2))(1.0)
    np.testing.assert_allclose(slope, 50.0, rtol=1e-13)  # of t², whose line between 0 and T has the slope T
    assert np.isnan(measure.mean_rate([1.0], [2.0]))


def test_an_angle_librates_if_it_never_crosses_its_bound():
    swings = np.stack([0.9 * np.sin(T), np.pi + 1.5 * np.sin(T), 1.6 * np.sin(T), 0.2 * T, 1.6 * np.sin(T)], axis=1)
    assert measure.is_librating(swings).tolist() == [True, True, False, False, False]
    assert measure.is_librating(swings, np.pi).tolist() == [True, False, True, False, True]
    assert measure.is_librating(np.abs(swings[:, 0]))
    assert not measure.is_librating(np.full_like(T, np.nan))


@given(st.lists(st.integers(0, 9), min_size=1, max_size=12), st.integers(0, 9))
def test_times_of_thresholds_are_those_of_a_search(values, limit):
    t, x = 2.0 + 0.5 * np.arange(len(values)), np.array(values, float)
    below = [time for time, v in zip(t, values, strict=True) if v < limit]
    first = below[0] if below else np.nan
    np.testing.assert_equal(measure.first_below(t, x, limit), first)
    late = next((t[k] for k in range(len(t)) if all(v <= limit for v in values[k:])), np.nan)
    np.testing.assert_equal(measure.captured_since(t, x, limit), late)
    between = measure.first_below(t, x, limit, interpolate=True)
    assert np.isnan(between) == np.isnan(first)
    if not np.isnan(first) and first > t[0]:
        assert first - 0.5 <= between <= first
        np.testing.assert_allclose(np.interp(between, t, x), limit, rtol=0, atol=1e-12)


def test_a_threshold_of_many_members_is_that_of_each():
    after_inf = np.where(T < 2, np.inf, 1.0)
    x = np.stack([10 - T, np.full_like(T, 3.0), np.abs(T - 30.0), np.where(T > 40, np.nan, 0.0), after_inf], axis=1)
    found = measure.first_below(T, x, 4.03, interpolate=True)
    np.testing.assert_allclose(found, [5.97, 0.0, 25.97, 0.0, T[T >= 2][0]], rtol=1e-13)
    np.testing.assert_equal(measure.captured_since(T, x[:, :4], 4.0), [6.0, 0.0, np.nan, np.nan])


def test_a_line_is_found_with_its_frequency_and_amplitude():
    """Observed 2e-8 of the frequency and 6e-7 of the amplitude, next to a weak line 13 resolutions away."""
    f, a = np.array([1.2345, 2.0]), np.array([0.7, 2.5])
    x = 4 + a * np.cos(2 * np.pi * T[:, None] * f + 0.4) + 0.01 * np.sin(2 * np.pi * T * 1.5)[:, None]
    found = measure.line(T, x, 0.9 * f, 1.1 * f)
    np.testing.assert_allclose(found.frequency, f, rtol=1e-7)
    np.testing.assert_allclose(found.amplitude, a, rtol=3e-6)
    backward = measure.line(-T, x, 0.9 * f, 1.1 * f)
    np.testing.assert_allclose(backward, found, rtol=1e-12)
    alone = measure.line(T, x[:, 0], 0.9 * f[0], 1.1 * f[0])
    assert alone.frequency == pytest.approx(found.frequency[0], rel=1e-13, abs=0)
    whole = measure.spectrum(T, x)
    assert whole.amplitude.shape == (201, 2)
    top = whole.amplitude.max(axis=0)
    assert (top <= a * 1.001).all()
    assert (top >= 0.84 * a).all()
    fastest = measure.spectrum(T[:-1], np.where(np.arange(400) % 2, -0.7, 0.7)).amplitude  # of 1/2Δt
    np.testing.assert_allclose(fastest[-1], 0.7, rtol=1e-14)


def test_a_long_run_in_float32_has_even_times():
    """At t = 2e4 times in steps of 0.1 are rounded to 0.002."""
    t = 0.1 * np.arange(200_000)
    x, rounded = 2.0 * np.cos(2 * np.pi * 0.0731 * t), t.astype(np.float32)
    found = measure.line(rounded, x, 0.07, 0.08)
    assert found.frequency == pytest.approx(0.0731, rel=1e-7)  # observed: 2e-8, the rounding of the last time
    assert found.amplitude == pytest.approx(2.0, rel=1e-6)  # observed: 3e-8
    assert measure.spectrum(rounded, x).amplitude.max() == pytest.approx(2.0, rel=1e-3)


def test_a_line_that_cannot_be_measured_is_nan():
    x = np.sin(T)
    assert np.isnan(measure.line(T, x, 0.001, 0.002)).all()
    assert np.isnan(measure.line(T, np.where(T > 3, np.nan, x), 0.1, 0.2)).all()
    assert np.isnan(measure.line(T[:3], x[:3], 0.1, 0.2)).all()
    for function in (measure.spectrum, lambda t, x: measure.line(t, x, 0.1, 0.2)):
        with pytest.raises(ValueError, match="evenly spaced: save every step or every n-th one"):
            function(T**2, x)
    with pytest.raises(ValueError, match="at least 4 times, got 2"):
        measure.spectrum(T[:2], x[:2])


def uneven(n, seed=5):
    return np.sort(np.random.default_rng(seed).uniform(2.4e6, 2.4e6 + 100.0, n))


def test_a_periodogram_is_that_of_scipy():
    """Generalized, with a floating mean and weights; observed 1e-14."""
    t, random = uneven(60), np.random.default_rng(2)
    x, errors = 5 + np.sin(2.1 * t) + random.normal(size=60), random.uniform(0.5, 2.0, 60)
    for e in (None, errors):
        found = measure.periodogram(t, np.stack([x, 1e3 - 7 * x], axis=1), e)
        weights = None if e is None else e**-2
        theirs = lombscargle(
            t - t[0], x, 2 * np.pi * found.frequency, normalize=True, weights=weights, floating_mean=True
        )
        np.testing.assert_allclose(found.power, np.stack([theirs, theirs], axis=1), rtol=0, atol=1e-13)
    resolution, duration = np.diff(found.frequency), np.ptp(t)
    np.testing.assert_allclose(resolution, 1 / (10 * duration), rtol=1e-9)
    assert found.frequency[0] == pytest.approx(1 / duration, rel=1e-12, abs=0)
    assert found.frequency[-1] == pytest.approx(59 / 2 / duration, abs=resolution[0])


@given(st.floats(0.05, 0.4), st.floats(-np.pi, np.pi), st.floats(-1e3, 1e3))
def test_a_pure_sine_explains_all_of_its_variance(f, phase, mean):
    t = uneven(40)
    found = measure.periodogram(t, mean + np.cos(2 * np.pi * f * t + phase), frequencies=[f, f + 0.1])
    assert found.power[0] == pytest.approx(1, abs=1e-9)
    assert found.false_alarm_probability[0] < 1e-100
    assert 0 <= found.power[1] < 0.9


def test_a_wave_that_even_times_do_not_see_explains_nothing():
    """At the Nyquist frequency the sine vanishes at all times, at twice that the cosine is constant."""
    t = np.arange(20.0)
    found = measure.periodogram(t, np.where(t % 2 == 0, 1.0, -1.0), frequencies=[0.5, 1.0])
    np.testing.assert_allclose(found.power, [1, 0], rtol=0, atol=1e-12)


def test_the_false_alarm_probability_is_the_share_of_white_noise_that_exceeds_it():
    """8000 series of noise at 40 uneven times; Baluev's bound exceeds the share where peaks depend on one another."""
    t = uneven(40, seed=7)
    noise = np.random.default_rng(11).normal(size=(40, 8000))
    found = measure.periodogram(t, noise, frequencies=np.arange(0.01, 0.2, 0.0005))
    least = found.false_alarm_probability.min(axis=0)
    for level, sharp in ((0.1, 0.9), (0.01, 0.95)):
        share, deviation = np.mean(least <= level), np.sqrt(level * (1 - level) / 8000)
        assert sharp * level - 3 * deviation < share < level + 3 * deviation


def test_a_periodogram_of_nothing_is_nan_and_bad_arguments_raise():
    t = uneven(20)
    x = np.stack([np.sin(t), np.ones(20), np.where(t > t[9], np.nan, t)], axis=1)
    found = measure.periodogram(t, x)
    assert np.isnan(found.power).any(axis=0).tolist() == [False, True, True]
    np.testing.assert_array_equal(np.isnan(found.power), np.isnan(found.false_alarm_probability))
    for bad in (
        dict(t=t[:4], x=t[:4]),
        dict(t=t, x=t[:9]),
        dict(t=t, x=t, errors=np.zeros(20)),
        dict(t=t, x=t, errors=np.ones(3)),
        dict(t=np.where(t > t[3], np.nan, t), x=t),
    ):
        with pytest.raises(ValueError, match="errors positive and finite"):
            measure.periodogram(**bad)
    for frequencies in ([0.0, 0.1], [], [[0.1]]):
        with pytest.raises(ValueError, match="frequencies must be finite and positive"):
            measure.periodogram(t, t, frequencies=frequencies)


def test_complex_rates_are_those_of_the_terms():
    """A growing and a decaying oscillation; a series that is too short has none."""
    t = np.linspace(0, 20, 300)
    z = 1e-3 * np.exp((0.2 + 1.5j) * t) + 0.5 * np.exp((-0.05 - 0.7j) * t)
    np.testing.assert_allclose(
        measure.complex_rates(t, z), [1.5 - 0.2j, -0.7 + 0.05j], rtol=0, atol=1e-11
    )  # observed: 2e-13
    assert np.isnan(measure.complex_rates(t, 0 * z)).all()
    cosine = measure.complex_rates(t, np.cos(1.3 * t))
    np.testing.assert_allclose(cosine, [1.3, -1.3], rtol=0, atol=2e-14)  # observed: 2e-15
    slow = measure.complex_rates(2.0**30 * t, z.conj())
    np.testing.assert_array_equal(2.0**30 * slow, measure.complex_rates(t, z.conj()))
    for short_or_bad in (z[:7], np.where(t > 5, np.nan, z)):
        assert np.isnan(measure.complex_rates(t[: len(short_or_bad)], short_or_bad)).all()


SERIES = {
    "unwrapped": measure.unwrapped,
    "mean_rate": measure.mean_rate,
    "captured_since": lambda t, x: measure.captured_since(t, x, 0.5),
    "first_below": lambda t, x: measure.first_below(t, x, 0.5, interpolate=True),
    "spectrum": measure.spectrum,
    "line": lambda t, x: measure.line(t, x, 0.1, 1.0),
    "complex_rates": measure.complex_rates,
    "periodogram": lambda t, x: measure.periodogram(t, x, frequencies=[0.2, 0.3, 0.5]),
    "sines": lambda t, x: measure.sines(t, x, np.arange(0.05, 1, 0.05), 2),
    "double_periods": lambda t, x: measure.double_periods(t, x, 0.1, 0.9, separation=0.1),
}
SHORT, SWING = np.linspace(0, 10, 41), np.sin(3 * np.linspace(0, 10, 41))
BAD = {
    "no times": (SHORT[:0], SWING[:0]),
    "fewer values": (SHORT, SWING[:30]),
    "fewer times": (SHORT[:30], SWING),
    "a number": (1.0, 2.0),
    "times in columns": (SHORT[:, None], SWING),
    "times with a NaN": (np.where(SHORT > 5, np.nan, SHORT), SWING),
    "infinite times": (np.where(SHORT > 5, np.inf, SHORT), SWING),
    "complex times": (1j * SHORT, SWING),
    "dates": (np.arange(41).astype("datetime64[s]"), SWING),
    "texts": ("ab", "cd"),
    "nothing": (None, None),
    "objects": (SHORT, SWING.astype(object)),
    "ragged": ([1, [2, 3]], [1, 2]),
}
EDGES = {
    "a constant": (SHORT, np.full(41, 2.5)),
    "zeros": (SHORT, 0 * SHORT),
    "backward": (SHORT[::-1], SWING),
    "integers": (np.arange(41, dtype=np.int8), np.arange(41, dtype=np.int8) % 3),
    "single precision": (SHORT.astype(np.float32), SWING.astype(np.float32)),
    "half precision": (SHORT.astype(np.float16), SWING.astype(np.float16)),
    "lists": (SHORT.tolist(), SWING.tolist()),
    "large": (SHORT, 1e150 * SWING),
    "small": (SHORT, 1e-150 * SWING),
    "subnormal": (SHORT, 1e-310 * SWING),
    "on a grid": (SHORT, np.sin(np.pi * SHORT)),
    "at the Nyquist frequency": (np.arange(40.0), np.cos(np.pi * np.arange(40))),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SERIES)
def test_a_series_that_is_none_is_refused_with_what_it_must_be(name):
    for t, x in BAD.values():
        with pytest.raises(ValueError, match=r"times|must hold|must be an array of numbers"):
            SERIES[name](t, x)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SERIES)
def test_series_at_their_edges_have_values_without_a_warning(name):
    for what, (t, x) in EDGES.items():
        if name == "double_periods" and what in ("a constant", "zeros"):
            with pytest.raises(ValueError, match="values that are not constant, got 41 times from 0 to 10"):
                SERIES[name](t, x)
        else:
            SERIES[name](t, x)
    above = name in ("sines", "double_periods", "first_below")  # the former two refuse it, the latter finds one before
    found = [] if above else SERIES[name](SHORT, np.where(SHORT > 9, np.inf, SWING))
    for x in jax.tree.leaves(found)[-1:]:
        assert np.isnan(x).any()


def test_nothing_has_no_frequency():
    """A constant has no line, no sine and one rate, 0; a series has as many rates and sines as terms."""
    for x in (np.full(41, 2.5), np.zeros(41)):
        assert np.isnan(measure.line(SHORT, x, 0.1, 1.0).frequency)
        assert measure.line(SHORT, x, 0.1, 1.0).amplitude < 1e-15
        assert measure.sines(SHORT, x, [0.1, 0.2], 3) == []
        assert np.isnan(measure.periodogram(SHORT, x, frequencies=[0.1]).power).all()
    np.testing.assert_allclose(measure.complex_rates(SHORT, np.full(41, 2.5)), [0, np.nan], rtol=0, atol=1e-13)
    np.testing.assert_allclose(measure.complex_rates(SHORT, SWING, 4)[:2], [3, -3], rtol=1e-12)
    assert np.isnan(measure.complex_rates(SHORT, SWING, 4)[2:]).all()
    assert len(measure.sines(np.arange(41.0), np.sin(np.pi / 2 * np.arange(41)), [0.1, 0.25], 5)) == 1
    for scale in (1e150, 1e-150, 1e-310):
        np.testing.assert_allclose(measure.complex_rates(SHORT, scale * SWING), [3, -3], rtol=1e-12)
        np.testing.assert_allclose(
            measure.periodogram(SHORT, scale * SWING, frequencies=[0.4]).power,
            measure.periodogram(SHORT, SWING, frequencies=[0.4]).power,
            rtol=1e-12,
        )
        np.testing.assert_allclose(
            measure.complex_rates(scale * SHORT, SWING) * scale if scale > 1e-300 else [3, -3], [3, -3], rtol=1e-12
        )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: measure.complex_rates(SHORT, SWING, 0), "count must be an integer ≥ 1, got 0"),
        (lambda: measure.complex_rates(SHORT, SWING, 2.0), "count must be an integer"),
        (lambda: measure.complex_rates(SHORT, np.stack([SWING, SWING], axis=1)), "call complex_rates for each series"),
        (lambda: measure.sines(SHORT, SWING, [0.1], 1.5), "count must be an integer"),
        (lambda: measure.sines(SHORT, SWING, [], 1), "frequencies must be finite and positive"),
        (lambda: measure.spectrum(np.full(41, 3.0), SWING), "the times must differ, got 41 times 3"),
        (lambda: measure.periodogram(np.full(41, 3.0), SWING), "the times must differ"),
        (lambda: measure.spectrum(SHORT, np.exp(1j * SHORT)), "must hold real numbers, got dtype complex128"),
        (lambda: measure.captured_since(SHORT, SWING, np.nan), "limit must be a number, got NaN"),
        (lambda: measure.first_below(SHORT, SWING, np.nan), "limit must be a number, got NaN"),
        (lambda: measure.is_librating(SWING, 0.0), "bound > 0"),
        (lambda: measure.is_librating([]), r"angle must be \(times, …\)"),
        (
            lambda: measure.double_periods(SHORT, SWING, 0.2, 1.0, separation=0.1, order=0),
            "order must be an integer ≥ 1",
        ),
        (
            lambda: measure.double_periods(SHORT, SWING, 0.2, 1.0, separation=0.1, count=0),
            "count must be an integer ≥ 1",
        ),
        (
            lambda: measure.double_periods(SHORT, SWING, 0.2, 1.0, separation=0.1, order=4),
            "more than its 81 coefficients",
        ),
        (lambda: measure.double_periods(SHORT, SWING, 1.0, 0.2, separation=0.1), "0 ≤ low < high"),
        (lambda: measure.double_periods(SHORT, SWING, 0.2, 1.0, separation=0.1, step=0.0), "step > 0"),
        (lambda: measure.double_periods(SHORT, SWING, 0.2, 1.0, separation=0.1, step=1e-9), "give a narrower band"),
    ],
)
def test_arguments_of_series_are_refused_with_what_is_allowed(call, words):
    with pytest.raises(ValueError, match=words):
        call()
