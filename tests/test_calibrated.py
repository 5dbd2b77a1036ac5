"""The calibrated step: exact at every step size of its branch, by constants found once; it tells what it is not for."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import _free_body, diagnostics, ensemble
from lieint_jax.groups import so3
from lieint_jax.schemes import calibrated, preprocessed
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

Q = so3.normalise(jnp.array([1.0, 2, -1, 0.5]))
TURN = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
FULL = TURN @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ TURN.T


def at(Pi):
    return State(Q, so3.Ad(Q, Pi))


def momenta(members=200):
    """Directions at random, about the axes, and on both sides of the separatrix."""
    rng = np.random.default_rng(1)
    Pi = rng.normal(size=(members, 3))
    Pi[: members // 4] *= [1e-6, 1, 1e-6]
    Pi[members // 4 : members // 2] *= [1e-9, 1e-9, 1]
    return jnp.asarray(Pi / np.linalg.norm(Pi, axis=1)[:, None])


one = jax.jit(jax.vmap(lambda J, Pi, dt: calibrated(RigidBody(J))(at(Pi), dt), (None, 0, None)))
flow = jax.jit(jax.vmap(lambda J, Pi, dt: RigidBody(J).solution(at(Pi), dt), (None, 0, None)))

derivative = jax.jit(jax.jacfwd(lambda J, Pi, dt: calibrated(RigidBody(J))(at(Pi), dt)[0].q, argnums=(0, 1, 2)))
true_derivative = jax.jit(jax.jacfwd(lambda J, Pi, dt: RigidBody(J).solution(at(Pi), dt).q, argnums=(0, 1, 2)))


@pytest.mark.parametrize(
    "J", [*itertools.permutations([1.0, 2.0, 3.0], 3), [1, 1, 2], [2, 1, 1], [1, 1, 1], [1, 2, 9], FULL]
)
def test_exact_where_it_converges_and_it_converges_up_to_70_degrees(J):
    J, Pi = jnp.asarray(J, float), momenta()
    for dt in (0.01, 0.4, -0.8, 1.4, 1.8, 2.5, 4.0, 6.0, 9.0, 15.0, 40.0):
        (state, info), true = one(J, Pi, dt), flow(J, Pi, dt)
        small = jnp.abs(dt) <= 1.2  # |Ω| ≤ 1, so the turn is less than 70°
        assert info.converged.all() or not small
        error = np.asarray(jax.vmap(so3.angle)(state.q, true.q))
        assert np.where(info.converged, error, 0).max() < 1e-13  # floor 2e-14, at 90°; 3e-15 up to 80°


def test_long_runs_with_constants_found_once():
    for J in (jnp.array([1.0, 2.0, 3.0]), FULL):
        body = RigidBody(J)
        state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
        run = jax.jit(li.integrate, static_argnums=(3, 4))(calibrated(body), state, 0.8, 500, 50)
        assert run.info.converged.all()
        assert float(so3.angle(run.state.q[-1], body.solution(state, 400.0).q)) < 3e-12  # floor 1e-12
        assert np.abs(diagnostics.energy_error(body, run)).max() < 1e-14  # floor 2e-15
        assert np.abs(diagnostics.momentum_error(body, run)).max() == 0


def test_constants_are_those_of_the_trajectory_and_the_preprocessed_ones_approach_them():
    body = RigidBody(jnp.array([1.0, 2.0, 3.0]))
    state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
    later = [
        _free_body.clock(body.inertia, body.body_momentum(body.solution(state, t)), 0.8)[:2] for t in (0, 1.7, 9, -4)
    ]
    assert np.ptp(np.array(later), axis=0).max() < 3e-15  # floor 6e-16
    steps = np.array([0.2, 0.1])
    exact = np.array([_free_body.clock(body.inertia, body.body_momentum(state), dt)[:2] for dt in steps])
    series = np.array([preprocessed(body, 6)._clock(state, dt) for dt in steps])
    ratio = np.abs(exact - series)[0] / np.abs(exact - series)[1]
    np.testing.assert_allclose(np.log2(ratio), 6, atol=0.1)


def test_symplectic_with_constants_held_fixed_or_found_anew():
    body = RigidBody(FULL)
    state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
    for step in (calibrated(body), calibrated(body).prepare(state, 0.7)):
        assert diagnostics.symplectic_defect(step, state, 0.7) < 5e-15  # floor 1e-15
        assert diagnostics.reversibility(step, state, 0.7) < 3e-15


@pytest.mark.parametrize("J", [[1, 2, 3], [1, 1, 2], [2, 1, 1], [1, 1, 1], [1, 1, 1 + 1e-9]])
def test_derivatives_are_those_of_the_exact_flow(J):
    """In J, Π and dt, where moments are equal too, and about every axis."""
    J = jnp.asarray(J, float)
    for Pi in ([0.3, 0.4, 0.5], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1e-9, 1, 0], [1, 1, 0], [0, 0, 0]):
        for dt in (0.3, 0.0):
            arguments = J, jnp.array(Pi, float), dt
            for a, b in zip(derivative(*arguments), true_derivative(*arguments), strict=True):
                assert np.abs(a - b).max() < 3e-15  # floor 3e-16


@pytest.mark.long
def test_gradients_go_through_the_constants():
    body = RigidBody(jnp.array([1.0, 2.0, 3.0]))
    state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
    by_steps = jax.grad(lambda J: li.integrate(calibrated(RigidBody(J)), state, 0.5, 8).state.q[-1, 1])(body.inertia)
    at_once = jax.grad(lambda J: RigidBody(J).solution(state, 4.0).q[1])(body.inertia)
    np.testing.assert_allclose(by_steps, at_once, atol=3e-14)


@pytest.mark.long
def test_an_ensemble_prepares_every_member():
    body = RigidBody(jnp.array([1.0, 2.0, 3.0]))
    states = jax.vmap(at)(momenta(20) * jnp.linspace(0.1, 1, 20)[:, None])
    run = ensemble.run(calibrated(body), states, 0.5, 80, progress=False)
    assert run.info.converged.all()
    true = jax.vmap(body.solution, (0, None))(states, 40.0)
    assert np.asarray(jax.vmap(so3.angle)(run.state.q[-1], true.q)).max() < 1e-12


def test_what_it_was_not_prepared_for_is_told():
    body = RigidBody(jnp.array([1.0, 2.0, 3.0]))
    state = at(jnp.array([0.3, 0.4, 0.5]))
    step = calibrated(body).prepare(state, 0.5)
    assert step(body.solution(state, 77.0), -0.5)[1].converged
    assert not step(state, 0.4)[1].converged
    other = State(state.q, state.p * (1 + 1e-9))
    assert not step(other, 0.5)[1].converged
    assert "prepared for another trajectory or for dt = 0.5" in step.advice(state, 0.4)
    with pytest.raises(ValueError, match="turns by more than 90° at dt = 9"):
        li.integrate(calibrated(body), state, 9.0, 1)
    body, fast = RigidBody(jnp.ones(3)), at(jnp.array([0.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match=r"turns by nearly 90° at dt = 1.5: .*up to 6 iterations"):
        li.integrate(calibrated(body), fast, 1.5, 1)
    assert calibrated(body, 6)(fast, 1.5)[1].converged
    with pytest.raises(ValueError, match="free rigid bodies"):
        calibrated("top")
    for iterations in (0, -1, 2.5):
        with pytest.raises(ValueError, match="iterations must be an integer ≥ 1"):
            calibrated(body, iterations)
    assert not calibrated(body)(State(state.q, state.p * jnp.nan), 0.5)[1].converged


@pytest.mark.long
def test_single_precision():
    J, Pi = jnp.array([1, 2, 3], "float32"), momenta().astype("float32")
    state, info = jax.vmap(lambda Pi: calibrated(RigidBody(J))(State(Q.astype("float32"), Pi), jnp.float32(0.5)))(Pi)
    true = jax.vmap(lambda Pi: RigidBody(J.astype(float)).solution(State(Q.astype("float32").astype(float), Pi), 0.5))(
        Pi.astype(float)
    )
    assert state.q.dtype == jnp.float32
    assert info.converged.all()
    assert np.abs(state.q - true.q).max() < 2e-6
