"""`lieint run kirchhoff`: what is kept, a steady motion, and its spin against the linearized equations."""

import jax
import numpy as np
import pytest

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import kirchhoff
from lieint_jax.systems import kirchhoff as ellipsoid


def test_the_spin_needed_is_where_the_linearized_equations_turn_unstable():
    """Kirchhoff's equations Π' = Π × Ω + P × v, P' = P × Ω about a steady motion, by autodiff: growth or none."""
    body = ellipsoid((1.0, 1.0, 2.99))
    need = kirchhoff.spin_needed(body)
    assert need == pytest.approx(1.9785, abs=1e-4)

    metric = np.diag(body.metric)
    slope = jax.jit(jax.jacfwd(lambda mu: body.group.ad_star(mu / metric, mu)))
    for spin, stable in ((1.01 * need, True), (0.99 * need, False)):
        slopes = np.linalg.eigvals(slope(np.array([0.0, 0.0, spin, 0.0, 0.0, 1.0])))
        assert (np.abs(slopes.real).max() < 1e-6) == stable
    assert kirchhoff.spin_needed(ellipsoid((2.0, 2.0, 1.0))) == 0  # broadside on, a disc needs no spin
    assert kirchhoff.spin_needed(ellipsoid((3.0, 2.0, 1.0))) is None


@pytest.mark.long
def test_kirchhoff_s_members_have_the_given_spread():
    scenario = scenarios.load("kirchhoff", members=500)
    step, states = scenario.build()
    velocities = np.linalg.solve(np.asarray(step.system.metric), np.asarray(states.p).T).T  # q is the identity
    np.testing.assert_allclose(velocities[0], [0, 0, 8, 0, 0, 1], rtol=0, atol=1e-15)
    assert np.std(velocities[1:, :3]) == pytest.approx(np.hypot(0.05, 8 * np.sqrt(2) / 3), rel=0.01)
    assert np.std(velocities[1:, 3]) == pytest.approx(0.02, rel=0.1)
