"""The tumbling body of fits: its parameters, and random guesses of given mean frequencies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.fitting import tumbling
from lieint_jax.groups import so3

BEGIN = so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2]))


def test_the_parameters_are_a_rotation_ratios_and_rates():
    """In degrees: the rotation vector is found again, and the body rate is that of the state."""
    params = {"attitude": jnp.array([10.0, -40.0, 25.0]), "inertia": jnp.array([0.6, 0.8])}
    body, state = tumbling.model(params | {"rate": jnp.array([30.0, 5.0, -12.0])}, BEGIN)
    found = tumbling.rotation_between(state.q, BEGIN)
    np.testing.assert_allclose(found, params["attitude"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(tumbling.rotate(found, BEGIN), state.q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.rad2deg(body.angular_velocity(state)), [30.0, 5.0, -12.0], rtol=1e-14)
    np.testing.assert_allclose(body.inertia, [0.6, 0.8, 1.0], rtol=0, atol=0)


def test_the_precession_is_that_of_the_axis_which_the_momentum_circles():
    """Of a symmetric body in closed form: P = 2πJ₁/L, for a long and for a flat one."""
    for moment in (2.5, 0.6):
        params = {"attitude": jnp.zeros(3), "inertia": jnp.full(2, moment), "rate": jnp.array([10.0, 0.0, 50.0])}
        body, state = tumbling.model(params, BEGIN)
        precession, _ = tumbling.mean_periods(body, state)
        assert float(precession) == pytest.approx(
            2 * np.pi * moment / float(jnp.linalg.norm(state.p)), rel=1e-12, abs=0
        )


@pytest.mark.long
@pytest.mark.parametrize(
    ("J", "rate"), [([3.0836, 3.235, 1.0], [0.25, 0.59, -1.72]), ([0.61, 0.965, 1.0], [0.3, 0.2, 1.0])]
)
def test_mean_periods_are_those_of_a_trajectory_of_a_long_and_of_a_short_axis_mode(J, rate):
    body = li.systems.rigid_body(J)
    state, scheme = body.state(angular_velocity=rate), li.schemes.exact(body)
    precession, rotation = np.asarray(jax.jit(tumbling.mean_periods)(body, state))
    run = li.run(scheme, state, rotation / 40, 4000, progress=False)
    np.testing.assert_allclose(
        [precession, rotation], li.measure.tumbling_periods(run)[:2], rtol=3e-9
    )  # the mean rate: 6e-10


@pytest.mark.long
def test_random_guesses_have_the_frequencies_of_their_candidates():
    """To the spacing of the pool: the ratio of both frequencies is chosen, then the rates are scaled."""
    candidates = np.array([[0.05, 0.02], [0.03, 0.04]])
    params, begin, which = tumbling.random_guesses(candidates, 40, jax.random.key(0))
    np.testing.assert_allclose(np.linalg.norm(begin, axis=1), 1, rtol=1e-14)
    assert (np.bincount(which) == 20).all()

    def frequencies(params, begin):
        return 1 / tumbling.mean_periods(*tumbling.model(params, begin))

    found = jax.jit(jax.vmap(frequencies))(jax.tree.map(jnp.asarray, params), jnp.asarray(begin))
    np.testing.assert_allclose(found, candidates[which], rtol=0.05)  # observed: 0.015
