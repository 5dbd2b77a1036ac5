"""A rigid body whose inertia is a function of time, free and with torques."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import quaternion_rate
from grid import examples_of
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import diagnostics, schemes, torques
from lieint_jax.systems import inertia_in_time, rigid_body

OMEGA, END = np.array([0.3, -0.4, 0.8]), 3.0


@jax.tree_util.Partial
def TENSOR(t):
    """Masses that move on rails askew: all six entries change."""
    rail = jnp.stack([0.3 + 0.2 * jnp.sin(t), 0.4 + 0.1 * t, 0.2 * jnp.cos(t)])
    return jnp.diag(jnp.array([1.0, 1.5, 2.0])) + rail @ rail * jnp.eye(3) - jnp.outer(rail, rail)


@functools.cache
def example(name):
    with jax.ensure_compile_time_eval():
        return examples_of("inertia_in_time")[name]


def cases():
    motor = torques.thruster([0.02, 0.05, 0.0], -1.0, 9.0)
    booms, burning = example("booms")[0], example("motor")[0]
    tensor = inertia_in_time(TENSOR, torque=torques.viscous(0.1) + motor)
    return {"booms": booms, "motor": burning, "tensor": tensor}


def by_scipy(inertia, torque):
    """q, π and the work of masses and torque by DOP853, from Euler's equations in numpy."""
    value = jax.jit(lambda t: jax.jvp(lambda t: jnp.asarray(inertia(t)), (t,), (1.0,)))

    def rates(t, z):
        J, rate = (np.asarray(x) if np.ndim(x) == 2 else np.diag(x) for x in value(t))
        q, Pi = z[:4], z[4:7]
        Omega = np.linalg.solve(J, Pi)
        T = torque(Omega)
        Pi_dot, power = np.cross(Pi, Omega) + T, Omega @ T - 0.5 * Omega @ rate @ Omega
        return np.concatenate([quaternion_rate(q, Omega), Pi_dot, [power]])

    J0 = np.asarray(inertia(jnp.zeros(())))
    start = np.concatenate([[1.0, 0, 0, 0], J0 * OMEGA if J0.ndim == 1 else J0 @ OMEGA, [0.0]])
    z = solve_ivp(rates, (0, END), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    q = z[:4] / np.linalg.norm(z[:4])
    return q, np.asarray(li.groups.so3.Ad(q, z[4:7])), z[7]


REFERENCES = {
    "booms": lambda _: np.zeros(3),
    "motor": lambda _: np.array([0.02, 0.05, 0.0]),
    "tensor": lambda Omega: np.array([0.02, 0.05, 0.0]) - 0.1 * Omega,
}


def steps_of(body):
    scheme = schemes.torqued_midpoint if hasattr(body, "torque") else schemes.so3_midpoint
    return scheme(body), body.state(angular_velocity=OMEGA, work=0.0)


@functools.partial(jax.jit, static_argnums=3)
def end_of(step, state, dt, num_steps):
    return jax.tree.map(lambda x: x[-1], li.integrate(step, state, dt, num_steps, save_every=num_steps).state)


def distance(state, reference):
    return max(float(np.abs(x - y).max()) for x, y in zip((state.q, state.p, state.work), reference, strict=True))


@pytest.mark.parametrize("name", ["booms", *(pytest.param(x, marks=pytest.mark.long) for x in ("motor", "tensor"))])
def test_the_motion_and_both_works_are_those_of_scipy(name):
    """By the schemes, of order 2."""
    body = cases()[name]
    reference = by_scipy(body.inertia, REFERENCES[name])
    assert abs(reference[2]) > 1e-3
    step, state = steps_of(body)
    errors = [distance(end_of(step, state, END / n, n), reference) for n in (50, 100)]
    assert errors[-1] < 1e-3
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.02


@pytest.mark.long
@pytest.mark.parametrize("name", ["booms", "tensor"])
def test_the_vector_field_is_that_of_scipy(name):
    """Observed: 2e-14 and 8e-14."""
    body = cases()[name]
    end = end_of(schemes.extrapolate(body), steps_of(body)[1], END / 30, 30)
    assert distance(end, by_scipy(body.inertia, REFERENCES[name])) < 1e-12


def test_momentum_is_exact_and_energy_less_work_is_round_off_in_a_long_run():
    """J breathes for 10⁵ steps. Observed: π bit for bit, H − W within 5e-14 of a work that swings by 0.4 of H."""
    body = inertia_in_time(lambda t: jnp.stack([1.0 + 0.5 * jnp.sin(t), 2.0 + 0 * t, 2.7 + 0.4 * jnp.sin(1.7 * t)]))
    step, state = steps_of(body)
    run = li.run(step, state, 0.05, 100_000, save_every=1000)
    assert run.converged
    np.testing.assert_array_equal(run.state.p, np.broadcast_to(state.p, run.state.p.shape))
    assert np.ptp(run.state.work) > 0.3 * body.energy(state)
    assert abs(run.energy_error()).max() < 2e-13 * body.energy(state)


def test_a_constant_inertia_is_a_free_body_to_round_off():
    """Not bit for bit: the inertia is a constant of the program. Observed: 3e-15 after 500 steps."""
    J = jnp.array([1.0, 2.0, 2.7])
    body = inertia_in_time(lambda t: J)
    step, state = steps_of(body)
    free = rigid_body(J)
    runs = [
        li.run(x, z, 0.05, 500) for x, z in ((step, state), (schemes.so3_midpoint(free), state._replace(work=None)))
    ]
    np.testing.assert_allclose(runs[0].state.q, runs[1].state.q, rtol=0, atol=2e-14)
    np.testing.assert_array_equal(runs[0].state.work, 0)


@pytest.mark.long
def test_it_is_symplectic_reversible_and_composes():
    body, state, dt = example("booms")
    step = schemes.so3_midpoint(body)
    certificate = diagnostics.certify(schemes.compose(step, 4), state, dt, 40)
    assert certificate.symplectic_defect < 1e-14  # observed: 6e-16
    assert certificate.reversibility < 1e-14
    assert certificate.momentum == 0
    assert certificate.energy < 1e-14
    assert abs(certificate.order - 4) < 0.1
    assert step.symmetric


def test_it_runs_in_machine_code():
    step, state = steps_of(example("booms")[0])
    assert li.explain(lambda z: li.integrate(step, z, 0.05, 10), state).engines == {"native"}


def test_an_inertia_that_is_not_positive_definite_is_reported():
    body = inertia_in_time(lambda t: jnp.array([1.0, 2.0, 2.5]) - t)
    step, state = steps_of(body)
    run = jax.jit(lambda z: li.integrate(step, z, 0.1, 12))(state)
    np.testing.assert_array_equal(run.info.converged, np.arange(13) * 0.1 < 0.95)
    with pytest.raises(ValueError, match=r"the inertia at t = 2\.0 must be positive definite"):
        body.state(angular_velocity=OMEGA, t=2.0)


@pytest.mark.long
def test_a_tensor_that_is_not_positive_definite_is_reported_with_a_torque():
    skew = inertia_in_time(lambda t: jnp.eye(3) + t * jnp.eye(3)[::-1], torque=torques.viscous(0.1))
    step = schemes.torqued_midpoint(skew)
    assert not jax.jit(step)(skew.state(angular_velocity=OMEGA, t=0.99), 0.1)[1].converged


@pytest.mark.long
def test_a_damper_in_a_body_that_deploys_booms_keeps_the_momentum():
    booms = example("booms")[0]
    body = inertia_in_time(booms.inertia, torque=torques.kane_damper(0.2, 0.1))
    state = body.state(angular_velocity=OMEGA, works=True)
    run = li.run(schemes.torqued_midpoint(body), state, 0.05, 200)
    assert abs(run.momentum_error()).max() < 1e-14
    assert abs(run.energy_error()).max() < 1e-14
    assert run.state.extra["works"][-1, 0] < 0  # that of the damper; the rest of the work is that of the booms
    assert abs(run.state.work - run.state.extra["works"][:, 0])[-1] > 0.1


def test_a_rate_may_be_given():
    moments, rate = jnp.array([1.0, 2.0, 2.7]), jnp.array([0.1, 0.2, 0.15])
    body = inertia_in_time(lambda t: moments + t * rate)
    given = inertia_in_time(lambda t: moments + t * rate, lambda t: rate)
    state = body.state(angular_velocity=OMEGA, work=0.0, t=0.3)
    a, b = body.vector_field(state), given.vector_field(state)
    np.testing.assert_allclose(a.work, -0.5 * np.sum(rate * OMEGA**2), rtol=1e-14)
    np.testing.assert_allclose(b.work, a.work, rtol=1e-15)
