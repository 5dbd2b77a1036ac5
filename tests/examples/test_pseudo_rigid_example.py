"""The example pseudo-rigid body: the energy variation of the paper's Figure 3c, and its members."""

import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after

from lieint_jax.examples import pseudo_rigid

pytestmark = pytest.mark.long


def float_after(words, text):
    return float(numbers_after(words, text)[0])


def test_the_first_quarter_of_figure_3c_has_the_variation_of_its_caption(tmp_path):
    text, _ = run_example(pseudo_rigid, tmp_path, members=3, steps=1000, rule="symplectic")
    assert "3 of 3 members converged" in text
    assert float_after("implicit midpoint rule", text) == pytest.approx(2.3e-3, rel=0.02)
    assert "published 0.0023" in text
    assert 1e-4 < float_after("energy, relative", text) < 1e-2  # 1.7e-3
    assert float_after("momentum, relative", text) < 3e-14
    assert 0.9 < float_after("least det F", text) < 1


def test_the_average_rule_conserves_the_energy_that_the_midpoint_rule_does_not(tmp_path):
    text, _ = run_example(pseudo_rigid, tmp_path, members=8)
    assert "8 of 8 members converged" in text
    assert float_after("energy, relative", text) < 2e-13  # floor 3e-14
    assert float_after("momentum, relative", text) < 1e-13  # floor 1e-14
    assert float_after("implicit midpoint rule", text) == pytest.approx(2.31e-3, rel=3e-3)
    assert float_after("the rule 'average'", text) < 5e-12


def test_members_are_spread_about_the_nominal_state(tmp_path):
    """The first is Figure 3c's; the seed decides on the others."""
    runs = []
    for seed, members in ((1994, 400), (1, 2)):
        folder = tmp_path / f"{seed}"
        folder.mkdir()
        runs.append(run_example(pseudo_rigid, folder, members=members, steps=8, seed=seed)[1])
    run, other = runs
    q, p = np.asarray(run.state.q[0]), np.asarray(run.state.p[0])
    np.testing.assert_array_equal(q[0], np.eye(3))
    momentum = np.asarray(run.map(lambda step, z: step.system.momentum(z)))[0]
    np.testing.assert_allclose(momentum[0], [0, 0, 6], rtol=0, atol=1e-15)
    assert np.std(q[1:] - np.eye(3)) == pytest.approx(0.01, rel=0.05)
    omega = p / 2 @ np.linalg.inv(q)
    np.testing.assert_allclose(omega, -np.swapaxes(omega, 1, 2), rtol=0, atol=1e-14)  # rotations only
    assert np.std(omega[1:, 2, 1]) == pytest.approx(0.05, rel=0.15)
    assert np.abs(np.asarray(other.state.q[0, 1]) - q[1]).max() > 1e-3
