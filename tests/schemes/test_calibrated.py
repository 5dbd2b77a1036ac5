"""The calibrated step: exact at every step size of its branch, by constants found once; it tells what it is not for."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import Q, moving, turned, with_momentum
from linearized import there_and_back
from repeated import once

import lieint_jax as li
from lieint_jax.core import State
from lieint_jax.core.tangent import distance
from lieint_jax.groups import so3
from lieint_jax.schemes import calibrated, preprocessed
from lieint_jax.systems import RigidBody

pytestmark = pytest.mark.long

J123 = jnp.array([1.0, 2.0, 3.0])
FULL = turned([1.0, 2.0, 3.0])


def state_with(Pi):
    return State(jnp.asarray(Q), so3.Ad(jnp.asarray(Q), Pi))


def momenta(members=200):
    """Directions at random, about the axes, and on both sides of the separatrix."""
    rng = np.random.default_rng(1)
    Pi = rng.normal(size=(members, 3))
    Pi[: members // 4] *= [1e-6, 1, 1e-6]
    Pi[members // 4 : members // 2] *= [1e-9, 1e-9, 1]
    return jnp.asarray(Pi / np.linalg.norm(Pi, axis=1)[:, None])


@jax.jit
def against_the_flow(J, Pi, dts):
    """Of every Π and step size: whether it converged, and the angle from the exact flow."""

    def compared(Pi, dt):
        (state, info), true = calibrated(RigidBody(J))(state_with(Pi), dt), RigidBody(J).solution(state_with(Pi), dt)
        return info.converged, so3.angle(state.q, true.q)

    return jax.lax.map(lambda dt: jax.vmap(compared, (0, None))(Pi, dt), dts)


def _both(J, Pi, dt):
    return calibrated(RigidBody(J))(state_with(Pi), dt)[0].q, RigidBody(J).solution(state_with(Pi), dt).q


@jax.jit
def both_derivatives(J, Pi, dt):
    """In J, Π and dt, of every Π and dt: of the step and of the exact flow, (cases, 4, 7) each."""

    def derivatives(Pi, dt):
        return jax.jacfwd(lambda x: _both(x[:3], x[3:6], x[6]))(jnp.concatenate([J, Pi, dt[None]]))

    return jax.lax.map(lambda case: derivatives(*case), (Pi, dt))


@pytest.mark.parametrize(
    "J", [*itertools.permutations([1.0, 2.0, 3.0], 3), [1, 1, 2], [2, 1, 1], [1, 1, 1], [1, 2, 9], FULL]
)
def test_calibrated_steps_are_exact_where_they_converge_up_to_70_degrees(J):
    dts = np.array([0.01, 0.4, -0.8, 1.4, 1.8, 2.5, 4.0, 6.0, 9.0, 15.0, 40.0])
    converged, error = (np.asarray(x) for x in against_the_flow(jnp.asarray(J, float), momenta(), dts))
    assert converged[np.abs(dts) <= 1.2].all()  # |Ω| ≤ 1, so the turn is less than 70°
    assert error[converged].max() < 1e-13  # floor 2e-14, at 90°; 3e-15 up to 80°


def test_long_runs_with_constants_computed_once_stay_exact():
    @jax.jit
    def measured(step, state):
        run = li.Run.of(step, li.integrate(step, state, 0.8, 500, save_every=50))
        off = so3.angle(run.state.q[-1], step.system.solution(state, 400.0).q)
        return run.info.converged, off, run.energy_error(), run.momentum_error()

    for J in (J123, FULL):
        converged, off, energy, momentum = measured(calibrated(RigidBody(J)), moving(J))
        assert converged.all()
        assert off < 3e-12  # floor 1e-12
        assert np.abs(energy).max() < 4e-14  # floor 1.2e-14, 1.7e-14 by XLA: a tenth of a rounding in each step
        assert np.abs(momentum).max() == 0


@pytest.mark.paper(
    "1.2", "the symplectic step is the exact flow but for one time scale and one turn about π", "schemes/_calibrated.py"
)
def test_constants_are_those_of_the_trajectory_and_the_preprocessed_ones_approach_them():
    body, state = RigidBody(J123), moving(J123)
    steps = np.array([0.2, 0.1])

    @jax.jit
    def constants(state):
        clock = jax.vmap(lambda z, dt: jnp.stack(calibrated(body).prepare(z, dt).clock[:2]))
        along = jax.vmap(lambda t: body.solution(state, t))(jnp.array([0, 1.7, 9, -4]))
        exact = clock(jax.tree.map(lambda x: jnp.stack([x] * 2), state), jnp.array(steps))
        series = jnp.stack([jnp.stack(preprocessed(body, 6)._clock(state, dt)[:2]) for dt in steps])
        return clock(along, jnp.full(4, 0.8)), exact, series

    later, exact, series = (np.asarray(x) for x in constants(state))
    assert np.ptp(later, axis=0).max() < 3e-15  # floor 6e-16
    ratio = np.abs(exact - series)[0] / np.abs(exact - series)[1]
    np.testing.assert_allclose(np.log2(ratio), 6, rtol=0, atol=0.1)


def test_calibrated_steps_are_symplectic_with_fixed_or_recomputed_constants():
    state, dt, step = moving(FULL), 0.7, calibrated(RigidBody(FULL))
    for each in (step, prepared(step, state, dt)):
        *_, form, back = jax.jit(there_and_back)(each, state, dt)
        assert form < 5e-15  # floor 1e-15
        assert distance(back, state) < 3e-15


@pytest.mark.parametrize("J", [[1, 2, 3], [1, 1, 2], [2, 1, 1], [1, 1, 1], [1, 1, 1 + 1e-9]])
def test_derivatives_of_calibrated_steps_are_those_of_the_exact_flow(J):
    """In J, Π and dt, where moments are equal too, and about every axis."""
    momenta = [[0.3, 0.4, 0.5], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1e-9, 1, 0], [1, 1, 0], [0, 0, 0]]
    cases = [(Pi, dt) for Pi in momenta for dt in (0.3, 0.0)]
    found, true = both_derivatives(np.array(J, float), *(np.array(x, float) for x in zip(*cases, strict=True)))
    assert found.shape == (14, 4, 7)
    assert np.abs(np.asarray(found) - true).max() < 3e-15  # floor 3e-16


prepared = jax.jit(lambda step, state, dt: step.prepare(state, dt))


def test_a_step_prepared_for_another_run_does_not_converge():
    body = RigidBody(J123)
    state = with_momentum([0.3, 0.4, 0.5])
    step = prepared(calibrated(body), state, 0.5)
    assert once(step, jax.jit(body.solution)(state, 77.0), -0.5)[1].converged
    assert not once(step, state, 0.4)[1].converged
    for Pi in ([0.3, 0.4, 0.5 + 1e-9], [0.4, 0.3, 0.5], [0.0, 0.0, 0.76**0.5]):  # the same |π|, the same energy
        assert not once(step, with_momentum(Pi), 0.5)[1].converged
    assert "prepared for another trajectory or for dt = 0.5" in step.advice(state, 0.4)
    with pytest.raises(ValueError, match="turns by more than 90° at dt = 9"):
        li.integrate(calibrated(body), state, 9.0, 1)
    body, fast = RigidBody(jnp.ones(3)), with_momentum([0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match=r"turns by nearly 90° at dt = 1.5: .*up to 6 iterations"):
        li.integrate(calibrated(body), fast, 1.5, 1)
    assert once(calibrated(body, 6), fast, 1.5)[1].converged
    assert not once(calibrated(body), State(state.q, state.p * jnp.nan), 0.5)[1].converged


def test_calibrated_steps_in_single_precision_have_its_accuracy():
    J, Pi = jnp.array([1, 2, 3], "float32"), momenta().astype("float32")
    q = jnp.array(Q, "float32")
    state, info = jax.vmap(lambda Pi: calibrated(RigidBody(J))(State(q, Pi), jnp.float32(0.5)))(Pi)
    body = RigidBody(J.astype(float))
    true = jax.vmap(lambda Pi: body.solution(State(q.astype(float), Pi), 0.5))(Pi.astype(float))
    assert state.q.dtype == jnp.float32
    assert info.converged.all()
    assert np.abs(state.q - true.q).max() < 2e-6


@pytest.mark.parametrize(("J", "Pi"), [([1, 1 + 1e-6, 1e-9], [0.8, -0.5, -1.2e-5]), ([1e-5, 1, 1], [-4e-4, 0.2, 0.4])])
def test_thin_rods_rotate_by_what_they_do_not_by_what_their_least_moment_allows(J, Pi):
    """The first one's energy changes by 10⁴ times the rounding of its attitude: that is no other trajectory."""
    body, state = RigidBody(jnp.asarray(J)), state_with(jnp.asarray(Pi))
    dt = 0.3 / np.abs(np.divide(Pi, J)).max()
    run = li.integrate(calibrated(body), state, dt, 20_000, save_every=1000)
    assert run.info.converged.all()
    true = body.solution(state, run.t[-1])
    assert so3.angle(run.state.q[-1], true.q) < 3e-6  # observed: 6e-7 and 9e-9
