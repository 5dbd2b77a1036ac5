"""The examples of tides: the Moon recedes as by the secular equations and as measured; pictures show small changes."""

import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after

from lieint_jax.examples import moon_tides, pluto_charon


@pytest.mark.long
def test_the_moon_recedes_as_measured(tmp_path):
    """A month of it: the power is that of the secular equations, and the rate too, and as lasers measure it.

    The spin changes by 6e-14 of itself in a step, and each time is rounded by 1e-16 the same way: its rate is known to
    1e-3. The work, which is counted from 0, has no such rounding; observed 3e-4, 6 (nΔt)²/8, as means are on chords.
    """
    text, _ = run_example(moon_tides, tmp_path, members=2, steps=320)
    rate, spread, published, _ = map(float, numbers_after("distance grows (cm a year)", text)[:4])
    G, day = 6.6743e-20, 86400.0
    (M, m), R, a = moon_tides.MASSES, moon_tides.RADII[0], moon_tides.DISTANCE
    n, omega = np.sqrt(G * (m + M) / a**3), 2 * np.pi / (moon_tides.PERIODS[0] * day)
    C = moon_tides.LOVE_NUMBERS[0] * G * m**2 * R**5 * 600.0
    secular = 6 * C / (m * M / (m + M) * a**7) * (omega / n - 1) * 365.25 * day * 1e5
    assert rate == pytest.approx(secular, rel=3e-3)
    power = 3 * C / a**6 * (omega - n) ** 2  # kg km²/s³, which is MW
    assert float(numbers_after("power lost (TW)", text)[0]) == pytest.approx(1e-6 * power, rel=5e-4)
    assert published == moon_tides.RECESSION.value
    assert rate == pytest.approx(published, rel=0.02)
    assert spread > 0


def test_the_picture_of_the_moon_shows_changes_relative_to_themselves():
    """Lines of the Moon's rates would be flat: they change by 2e-10 of themselves in a year."""
    t = np.linspace(0.0, 10.0, 11)
    spins = np.stack([6.3 - 1e-9 * t, np.full(11, 0.2)], axis=1)
    constant = 1 + 1e-15 * t
    distance, rates, balances = moon_tides.draw_course(t, 384400 + 1e-5 * t, spins, constant, constant).axes
    assert distance.get_ylabel() == "growth from 384400 km (cm)"
    assert distance.lines[0].get_ydata()[-1] == pytest.approx(10.0, rel=3e-7)
    assert rates.get_ylabel() == "relative change"
    assert rates.lines[0].get_ydata()[-1] == pytest.approx(-1e-8 / 6.3, rel=1e-7)
    assert rates.lines[1].get_ydata().tolist() == [0.0] * 11
    assert balances.get_yscale() == "log"


def test_the_picture_of_pluto_and_charon_has_the_distance_of_the_locked_state():
    t = np.linspace(0.0, 10.0, 11)
    spins = np.stack([9.4 - 0.1 * t, np.full(11, 1.3)], axis=1)
    constant = 1 + 1e-15 * t
    distance, rates, _ = pluto_charon.draw_course(t, 16000 + 360 * t, spins, 19596.0, constant, constant).axes
    assert list(distance.lines[1].get_ydata()) == [19596.0, 19596.0]
    assert rates.get_ylabel() == "angular rate (rad/d)"
    assert rates.lines[0].get_ydata()[-1] == pytest.approx(8.4, rel=1e-15, abs=0)
