"""`lieint run kirchhoff`: what is kept, a steady motion, and its spin against the linearized equations."""

import numpy as np
import pytest

from lieint_jax.app import scenarios


@pytest.mark.long
def test_kirchhoff_s_members_have_the_given_spread():
    scenario = scenarios.load("kirchhoff", members=500)
    step, states = scenario.build()
    velocities = np.linalg.solve(np.asarray(step.system.metric), np.asarray(states.p).T).T  # q is the identity
    np.testing.assert_allclose(velocities[0], [0, 0, 8, 0, 0, 1], rtol=0, atol=1e-15)
    assert np.std(velocities[1:, :3]) == pytest.approx(np.hypot(0.05, 8 * np.sqrt(2) / 3), rel=0.01)
    assert np.std(velocities[1:, 3]) == pytest.approx(0.02, rel=0.1)
