"""The example Maclaurin: rates of bars next to Chandrasekhar's closed form, and what the scheme conserves."""

import re

import numpy as np
import pytest
from example_runs import run_example
from kept_values import KEPT, is_same, numbers_after

from lieint_jax import systems
from lieint_jax.examples import maclaurin


def test_the_published_limits_are_those_of_the_closed_form():
    assert abs(systems.maclaurin_modes(maclaurin.SECULAR)[1]) < 2e-6
    below, above = (systems.maclaurin_modes(maclaurin.DYNAMICAL + d)[0].imag for d in (-2e-6, 2e-6))
    assert below == 0 < abs(above)


@pytest.mark.long
def test_rates_of_bars_are_those_that_were_kept(tmp_path):
    """Measured and in closed form, with their differences: those of the scheme of fourth order, at most 1e-7."""
    text, _ = run_example(maclaurin, tmp_path, members=3)
    rows = [re.findall(r"[-+]?\d\.\d+(?:e-\d+)?", line) for line in text.splitlines() if line.endswith("e-08")]
    for found, kept in zip(rows, KEPT["maclaurin"]["rates"], strict=True):
        assert all(map(is_same, found, kept.split())), (found, kept)
    for words, bound in {"energy, relative": 5e-13, "momentum, relative": 5e-13, "volume, relative": 5e-13}.items():
        assert float(numbers_after(words, text)[0]) < bound
    assert 1e-10 < float(numbers_after("circulation, relative", text)[0]) < 1e-6


@pytest.mark.long
def test_bars_rotate_and_grow_as_in_the_closed_form(tmp_path):
    """Of more eccentricities, beyond that where a bar must grow, in a shorter run."""
    _, run = run_example(maclaurin, tmp_path, members=4, steps=300, first=0.3, last=0.975)
    measured, known = maclaurin.measured_rates(run), systems.maclaurin_modes(np.linspace(0.3, 0.975, 4))
    assert abs(measured - known).max() < 2e-6
    assert abs(measured[3].imag).min() > 0.2
