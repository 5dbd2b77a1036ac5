"""Rotating liquid spheroids: the modes of their bars, against Chandrasekhar's closed form."""

import numpy as np
import pytest
import scenario_runs
from scipy.integrate import quad

from lieint_jax import systems
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import maclaurin


def run(**changes):
    scenario = scenarios.load("maclaurin", **changes)
    return scenario, scenario_runs.run(scenario)


@pytest.mark.parametrize("e", [0.2, 0.7, 0.97])
def test_the_closed_form_is_chandrasekhars_integral(e):
    a, Omega = systems.maclaurin_spheroid(e)
    c = a * np.sqrt(1 - e * e)
    B11 = a * a * c * quad(lambda u: u / ((a * a + u) ** 3 * np.sqrt(c * c + u)), 0, np.inf, epsabs=1e-14)[0]
    known = systems.maclaurin_modes(e)
    assert known.sum() == pytest.approx(2 * Omega, rel=1e-14, abs=0)
    assert ((known[0] - known[1]) / 2) ** 2 == pytest.approx(3 * B11 - Omega**2, rel=1e-8)


def test_the_published_limits_are_those_of_the_closed_form():
    assert abs(systems.maclaurin_modes(maclaurin.SECULAR)[1]) < 2e-6
    below, above = (systems.maclaurin_modes(maclaurin.DYNAMICAL + d)[0].imag for d in (-2e-6, 2e-6))
    assert below == 0 < abs(above)


@pytest.mark.long
def test_bars_rotate_and_grow_as_in_the_closed_form():
    """Errors are 1e-4 at order 2 and Δt = 0.1; volume, energy and momentum are at round-off."""
    scenario, made = run(members=4, steps=300, order=2, eccentricity=0.3, last_eccentricity=0.975)
    off = maclaurin.measured_modes(made) - systems.maclaurin_modes(scenario.eccentricities())
    assert abs(off).max() < 2e-3  # 7e-4
    assert abs(maclaurin.measured_modes(made)[3].imag).min() > 0.2
    *exact, circulation = scenario.conserved(made)
    for quantity in exact:
        assert quantity.change().max() < 5e-13, quantity.name
    assert 1e-12 < circulation.change().max() < 1e-3
    text = scenario.report(made)
    assert "growth" in text
    assert "Chandrasekhar" in text


@pytest.mark.long
def test_the_shipped_scenario_agrees_to_its_fourth_order():
    scenario, made = run()
    e = scenario.eccentricities()
    off = abs(maclaurin.measured_modes(made) - systems.maclaurin_modes(e))
    away = abs(e - maclaurin.DYNAMICAL) > 0.01  # where the two rates of a bar can be told apart
    assert off[away].max() < 1e-6  # 1e-7
