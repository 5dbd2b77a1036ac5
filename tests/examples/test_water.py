"""The example water: the grid, the settled droplet, what is conserved, the temperature and the first distance."""

import jax
import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after

import lieint_jax as li
from lieint_jax.examples import water


def test_the_grid_has_the_spacing_and_its_middle_at_the_origin():
    points = water.grid(64)
    assert points.shape == (64, 3)
    np.testing.assert_allclose(points.mean(axis=0), 0, rtol=0, atol=1e-15)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)[np.triu_indices(64, 1)]
    assert apart.min() == pytest.approx(0.31, rel=2e-15, abs=0)
    assert np.linalg.norm(points, axis=1).max() < 0.31 * 2.7  # a ball of 64 cells has a radius of 2.48 of them


@pytest.mark.long
def test_a_droplet_conserves_its_momenta_and_has_the_first_peak_of_water(tmp_path):
    """The first peak of one droplet of 8 scatters by 0.005 nm, too much for its bound; of 8 droplets by 0.002."""
    text, run = run_example(water, tmp_path, members=8, molecules=8, steps=400)
    assert "8 of 8 members converged" in text
    assert 1e-6 < float(numbers_after("energy H, over the least kinetic energy", text)[0]) < 1e-2
    for kind in ("linear", "angular"):
        assert float(numbers_after(f"{kind} momentum, over the largest of a body", text)[0]) < 3e-14
    peak = float(numbers_after("first peak of the O–O distances (nm); published, liquid", text)[0])
    assert peak == pytest.approx(0.276, abs=0.01)
    temperatures = run.map(water.temperature)
    np.testing.assert_allclose(temperatures[0], water.SETTLING_TEMPERATURE, rtol=1e-12)
    energies = np.asarray(run.map(lambda step, z: step.system.energy(z)))[0]
    assert np.ptp(energies) > 1  # eight droplets, not one
    P = np.asarray(jax.vmap(run.system.momentum)(jax.tree.map(lambda x: x[0], run.state)))[:, :3]
    assert abs(P).max() < 1e-12 * abs(np.asarray(run.state.p[0])).max()
    distances = li.measure.distances(run, li.potentials.water("TIP4P").points[0])
    assert distances.min() > 0.23  # between oxygens; hydrogen bonds bring hydrogens to 0.18
