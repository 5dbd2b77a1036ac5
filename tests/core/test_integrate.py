"""The scan driver: what it saves, that it is one function of its arguments, what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import State

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = jax.jit(BODY.state)(np.array([1.0, 2, -1, 0.5]) / 2.5, angular_velocity=[0.3, -0.5, 0.8])
STEP = li.schemes.so3_midpoint(BODY)
integrate = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))


def test_saves_every_kth_state_and_the_worst_of_the_steps_between():
    every, some = jax.device_get([integrate(STEP, STATE, 0.1, 12), integrate(STEP, STATE, 0.1, 12, save_every=4)])
    np.testing.assert_allclose(every.t, 0.1 * np.arange(13), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(some.t, every.t[::4])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[::4]), some.state, every.state)
    worst = every.info.residual[1:].reshape(3, 4).max(axis=1)
    np.testing.assert_array_equal(some.info.residual, np.concatenate([[0], worst]))
    assert some.info.converged.shape == (4,)
    state, step = STATE, jax.jit(STEP.__call__)
    for k in range(3):
        np.testing.assert_allclose(every.state.q[k], state.q, rtol=0, atol=4e-16)
        state, _ = step(state, 0.1)


@pytest.mark.long
def test_a_run_is_one_loop():
    for save_every in (1, 4, 8):
        made = jax.make_jaxpr(lambda z, every=save_every: li.integrate(STEP, z, 0.1, 8, save_every=every))(STATE)
        assert str(made).count("march[") == 1


def test_a_run_of_zero_steps_is_its_start():
    run = integrate(STEP, STATE, 0.1, 0)
    assert run.t.shape == (1,)
    np.testing.assert_array_equal(run.state.q, [STATE.q])


@pytest.mark.long
def test_mixed_precisions_and_integers_are_promoted():
    single = jax.tree.map(lambda x: np.asarray(x, "float32"), STATE)
    assert integrate(STEP, single, 0.1, 2, save_every=1).state.q.dtype == jnp.float64
    whole = State(jnp.array([1, 0, 0, 0]), jnp.array([0, 1, 1]))
    assert li.integrate(STEP, whole, 0.1, np.int64(4), save_every=np.int64(2)).state.q.shape == (3, 4)


def test_a_run_that_leaves_the_branch_later_is_flagged():
    """Ω grows in the flip of the intermediate axis: the first steps are within the branch, a later one is not."""
    state = State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 2.0, 3e-4]))  # Ω = (0, 1, 1e-4)
    step = li.schemes.so3_midpoint(BODY, iterations=8)
    within, beyond = (np.asarray(integrate(step, state, dt, 40).info.converged) for dt in (0.95, 0.99))
    assert within.all()
    assert beyond[:5].all()
    assert not beyond.all()
