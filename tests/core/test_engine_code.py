"""The three steps in C for authors of engines, against the package, to round-off."""

import engine_code
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lieint_jax as li

Q = np.array([0.5, -0.1, 0.7, 0.5]) / np.sqrt(0.25 + 0.01 + 0.49 + 0.25)


def energy(body, q, p):
    return float(body.energy(li.State(jnp.asarray(q), jnp.asarray(p))))


@pytest.mark.long
@pytest.mark.parametrize(("call", "scheme"), [("midpoint", "so3_midpoint"), ("explicit", "so3_explicit")])
@pytest.mark.parametrize("J", [[1.0, 2.0, 2.5], [2.0, 0.3, 2.1], [1.0, 1.0, 1.0], [1.0, 1.0, 1.7]])
@pytest.mark.parametrize("dt", [0.1, -0.25])
def test_free_bodies_are_those_of_the_package(call, scheme, J, dt):
    body = li.systems.rigid_body(J)
    state = body.state(Q, angular_velocity=[0.7, -1.1, 1.3])
    q, p, solved = getattr(engine_code, call)(J, state, dt, 50)
    run = li.run(getattr(li.schemes, scheme)(body), jax_batch(state), dt, 50, progress=False, save_every=None)
    assert solved
    np.testing.assert_allclose(q, run.state.q[-1, 0], rtol=0, atol=2e-13)  # 6e-14, of the rod
    assert (p == np.asarray(state.p)).all()
    assert abs(energy(body, q, p) / energy(body, state.q, state.p) - 1) < 2e-15


def jax_batch(state):
    return li.State(np.asarray(state.q)[None], np.asarray(state.p)[None], state.t, state.work)


def law(t, q, Omega):
    """Drag, a push that oscillates, and a spring to the attitude 1."""
    xp = jnp if isinstance(q, jnp.ndarray) else np
    return -0.3 * Omega + xp.array([0.2, 0.0, 0.1]) * xp.sin(2 * t) - 0.5 * q[0] * q[1:]


@pytest.mark.long
def test_a_torqued_body_is_that_of_the_package():
    J, dt = [1.0, 2.0, 2.5], 0.1
    body = li.systems.torqued_body(J, law)
    state = body.state(Q, angular_velocity=[0.7, -1.1, 1.3], t=0.0, work=0.0)
    q, p, work, solved = engine_code.torqued(J, law, state, dt, 100)
    run = li.run(li.schemes.torqued_midpoint(body), jax_batch(state), dt, 100, progress=False, save_every=None)
    assert solved
    np.testing.assert_allclose(q, run.state.q[-1, 0], rtol=0, atol=1e-14)  # 1e-15: drag forgets
    np.testing.assert_allclose(p, run.state.p[-1, 0], rtol=0, atol=1e-14)
    assert work == pytest.approx(float(run.state.work[-1, 0]), abs=1e-14)


@pytest.mark.long
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(0.5, 1.0), min_size=3, max_size=3),
    st.floats(-0.3, 0.3).filter(lambda dt: abs(dt) > 1e-3),
)
def test_the_kinetic_energy_changes_by_the_work(velocity, J, dt):
    body = li.systems.rigid_body(J)
    state = body.state(Q, angular_velocity=velocity)
    q, p, work, solved = engine_code.torqued(J, law, state, dt, 5)
    start = energy(body, state.q, state.p)
    assert solved
    assert abs(energy(body, q, p) - work - start) < 2e-14 * (1 + start)


def test_a_step_beyond_the_limit_says_that_it_failed():
    body = li.systems.rigid_body([1.0, 2.0, 2.5])
    state = body.state(angular_velocity=[0.0, 0.0, 1.0])
    assert not engine_code.midpoint([1.0, 2.0, 2.5], state, 1.2, 1)[-1]
    assert engine_code.midpoint([1.0, 2.0, 2.5], state, 0.9, 1)[-1]
