"""Nutation and precession of tops and pendulums, against their motion in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import measure
from lieint_jax.groups import so3

TILTED = so3.exp(jnp.array([0.5, -0.2, 0.3]))


def go(step, states, dt, num_steps, **options):
    return li.run(step, states, dt, num_steps, progress=False, **options)


@jax.vmap
def fast_tops(weight, spin):
    top = li.systems.heavy_top([5.0, 5.0, 1.0], jnp.array([0.0, 0.0, 1.0]) * weight, [0.0, 0.6, 0.8])
    return li.schemes.nystrom(top, 6), top.state(TILTED, angular_velocity=jnp.stack([0.4, 0.2, spin]))


@pytest.fixture(scope="module")
def tops():
    """Three tops of their own weights, one of them hanging, for some ten nutations."""
    weights, spins = jnp.array([20.0, 12.0, -15.0]), jnp.array([50.0, 40.0, 6.0])
    step, states = fast_tops(weights, spins)
    return go(step, states, 0.01, 1600, own_step=True, save_every=2)


def test_nutation_is_that_of_lagrange_in_closed_form(tops):
    """Observed 6e-14."""
    found = measure.nutation(tops)
    exact = jax.vmap(li.systems.lagrange_motion)(tops.system, jax.tree.map(lambda x: x[0], tops.state))
    np.testing.assert_allclose(found.period, exact.nutation_period, rtol=1e-12)
    np.testing.assert_allclose(found.precession_rate, exact.precession_rate, rtol=1e-12)
    np.testing.assert_allclose(np.stack([found.least, found.greatest], axis=1), exact.inclination, rtol=0, atol=1e-12)
    one = measure.nutation(tops.member(1), axis=[0.0, 0.0, 1.0])
    np.testing.assert_allclose(one, [x[1] for x in found], rtol=1e-13)
    assert not np.isnan(measure.nutation(tops.member(2), axis=[0.0, 0.0, -1.0]).period)
    assert one.period.shape == ()


@pytest.mark.long
def test_nutation_of_a_pendulum_is_that_of_a_top_without_spin():
    """About γ, which is down for a pendulum, also where gravity is negative and it swings about −γ."""
    gamma = np.array([0.36, -0.48, 0.8])
    for gravity in (3.0, -3.0):
        bob = li.systems.pendulum(1.5, gravity, gamma)
        state = bob.state([0.6, 0.8, 0.0], velocity=[0.32, -0.24, 0.9])
        run = go(li.schemes.compose(li.schemes.sphere_midpoint(bob, True), 6), state, 0.02, 600)
        found = measure.nutation(run)
        top = li.systems.heavy_top(np.full(3, 1.5), [0.0, 0.0, 1.5 * gravity], -gamma)
        across = jnp.stack([*li.phase_spaces.frame(state.q), state.q], axis=1)
        exact = li.systems.lagrange_motion(top, li.State(so3.from_matrix(across), state.p))
        np.testing.assert_allclose(found.period, exact.nutation_period, rtol=2e-12)
        down = np.sign(gravity)  # the axis to the center of mass is −q for a negative weight
        np.testing.assert_allclose(found.precession_rate, -exact.precession_rate, rtol=2e-12)
        angles = np.sort(np.pi - exact.inclination) if down > 0 else exact.inclination
        with pytest.raises(ValueError, match="which have attitudes"):
            measure.tilt(run)
        np.testing.assert_allclose([found.least, found.greatest], angles, rtol=0, atol=2e-13)


@pytest.mark.long
def test_a_nutation_that_is_not_shown_is_nan(tops):
    start = jax.tree.map(lambda x: x[0], tops.state)
    found = measure.nutation(go(tops.step, start, 0.01, 1600, own_step=True, save_every=40))
    assert np.isnan([found.period[:2], found.precession_rate[:2]]).all()
    assert (found.least < found.greatest).all()
    assert np.isnan(measure.nutation(go(tops.step, start, 0.01, 0, own_step=True)).period).all()
    top = li.systems.potential_top([1.0, 2.0, 2.5], _no_center)
    run = go(li.schemes.splitting(top), top.state(angular_velocity=[0.1, 0.2, 1.0]), 0.1, 8)
    with pytest.raises(ValueError, match="give the axis of the top in the body"):
        measure.nutation(run)
    assert np.isnan(measure.nutation(run, axis=[0, 0, 1]).period)


@pytest.mark.long
def test_a_batch_of_times_of_their_own_has_no_common_nutation():
    """In steps of a fictitious time, which a batch counts, the period would be 2.8 times too long."""
    top = li.systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, -3.0], [0.0, 0.0, 1.0])
    state = top.state(TILTED, angular_velocity=[0.4, 0.2, 5.0])._replace(t=jnp.zeros(()))
    step = li.schemes.log_hamiltonian(top, top.energy(state))
    run = go(step, jax.tree.map(lambda x: jnp.stack([x, x]), state), 0.02, 40)
    assert float(run.t[-1]) > 2 * float(run.state.t[-1, 0])
    with pytest.raises(ValueError, match=r"each member has its own times: give one of them, run\.member\(k\)"):
        measure.nutation(run)
    with pytest.raises(ValueError, match="times must be evenly spaced"):
        measure.nutation(run.member(0))


def _no_center(Gamma):
    return Gamma[0] * Gamma[1]
