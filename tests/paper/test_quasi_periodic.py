"""Section 6.3, "the approximate energy appears to be quasi-periodic": the spectra of the energies of Figure 4.

The energy on a torus of two frequencies is a sum of lines at k₁f₁ + k₂f₂ with integers k. Fitted to one part of a run,
such a sum predicts the next part.
"""

import functools
import itertools

import jax
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import lieint_jax as li

DT, PART = 0.05, 4000


@jax.jit
def _energies(spin):
    ball = li.systems.pseudo_rigid_body(np.full(3, 2.0), li.systems.mooney_rivlin(2000.0, 6.0))
    state = ball.state(angular_velocity=spin * np.array([0.0, 0.0, 0.5]))
    run = li.integrate(li.schemes.additive(ball, "symplectic"), state, DT, 3 * PART)
    return jax.vmap(ball.energy)(run.state), run.info.converged


@functools.cache
def parts(Phi):
    """The energy of the ball with π = (0, 0, Phi) at steps 1 to 4000, 4001 to 8000 and 8001 to 12000."""
    H, converged = jax.device_get(_energies(Phi))
    assert converged.all()
    return H[1:].reshape(3, PART)


def design(times, frequencies):
    """The columns 1, cos 2πft and sin 2πft."""
    angle = 2 * np.pi * np.outer(times, frequencies)
    return np.hstack([np.ones((len(times), 1)), np.cos(angle), np.sin(angle)])


def fit(x, frequencies, times):
    return np.linalg.lstsq(design(times, frequencies), x, rcond=None)[0]


def two_strongest(x):
    """The frequencies of the greatest line of the Hann-windowed spectrum, and of the greatest of what it leaves."""
    times, window, found = DT * np.arange(len(x)), np.hanning(len(x)), []
    for _ in range(2):
        rest = window * (x - design(times, found) @ fit(x, found, times))
        k = np.abs(np.fft.rfft(rest)).argmax()
        bins = np.array([k - 1, k + 1]) / (DT * len(x))
        line = functools.partial(lambda rest, f: -abs(rest @ np.exp(-2j * np.pi * f * times)), rest)
        found.append(minimize_scalar(line, bounds=bins, method="bounded", options={"xatol": 1e-12}).x)
    return np.array(found)


def prediction_error(x, after, basic):
    """Fit lines at k₁f₁ + k₂f₂, |k₁| ≤ 12 and |k₂| ≤ 3, to x; the error of their sum in the next part, relative."""
    lines = [np.dot(k, basic) for k in itertools.product(range(-12, 13), range(-3, 4)) if k > (0, 0)]
    times = DT * np.arange(len(x))
    predicted = design(times + DT * len(x), lines) @ fit(x, lines, times)
    return np.std(after - predicted) / np.std(after)


@pytest.mark.paper("6.3", "the energy is quasi-periodic in Figure 4 (a)", "schemes/_additive.py")
@pytest.mark.long
def test_6_3_the_energy_of_figure_4_a_is_quasi_periodic_with_two_frequencies():
    """With a wrong second frequency as many lines predict nothing."""
    first, second, third = parts(6.0)
    basic = two_strongest(first)
    np.testing.assert_allclose(basic, [0.475548, 6.724019], rtol=0, atol=1e-6)
    np.testing.assert_allclose(two_strongest(third), basic, rtol=0, atol=2e-8)  # they differ by 5e-9
    assert prediction_error(first, second, basic) < 1e-3  # 3.6e-4; with |k₁| ≤ 16 and |k₂| ≤ 4 it is 1.4e-5
    assert prediction_error(first, second, basic * [1, 1.01]) > 0.5


@pytest.mark.long
def test_6_3_the_energy_of_figure_4_c_is_not_quasi_periodic():
    """Once its symmetry is broken, after step 3000, its strongest lines change and predict nothing."""
    _, second, third = parts(10.0)
    basic = two_strongest(second)
    assert np.abs(two_strongest(third) - basic).min() > 1e-3  # 0.06 and 0.08; they depend on rounding
    assert prediction_error(second, third, basic) > 0.5  # 1.3
