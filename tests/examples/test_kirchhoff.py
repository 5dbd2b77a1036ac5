"""The example Kirchhoff, a spheroid in water: its members, and the spin that Lamb requires for a steady heading."""

import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after

from lieint_jax import systems
from lieint_jax.examples import kirchhoff

pytestmark = pytest.mark.long


def test_members_have_the_given_spread(tmp_path):
    _, run = run_example(kirchhoff, tmp_path, members=500, steps=20)
    velocities = np.linalg.solve(np.asarray(run.system.metric), np.asarray(run.state.p[0]).T).T  # q is the identity
    np.testing.assert_allclose(velocities[0], [0, 0, 8, 0, 0, 1], rtol=0, atol=1e-15)
    assert np.std(velocities[1:] - velocities[0], axis=0) == pytest.approx(np.repeat([0.05, 0.02], 3), rel=0.1)


@pytest.mark.parametrize(("factor", "stable"), [(0.6, False), (1.1, True)])
def test_the_heading_is_steady_above_the_spin_that_lamb_requires(factor, stable, tmp_path):
    body = systems.kirchhoff((1.0, 1.0, 2.99))
    metric = np.diag(np.asarray(body.metric))
    spin = factor * float(systems.kirchhoff_spin(body)) * metric[5] / metric[2]
    text, _ = run_example(kirchhoff, tmp_path, members=10, spin=spin)
    assert ("not stable" in text) != stable
    tilt, spread = map(float, numbers_after("third axis strays by (°)", text))
    assert tilt < 1e-4  # without a deviation an axis stays where it is
    assert (spread < 15) == stable  # 26 and 9.5
    assert float(numbers_after("Π·P and |P|², relative", text)[0]) < 1e-12
