"""Transition matrices and sensitivities: against differences of sixth order, reverse mode and the symplectic form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import slopes
from grid import systems as all_systems

import lieint_jax as li
from lieint_jax.core import State
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

EXAMPLES = dict(all_systems())
SATELLITE, TILTED, _ = EXAMPLES["gravity_gradient.satellite"]
TOP, SPINNING, _ = EXAMPLES["heavy_top.asymmetric_top"]
DT, STEPS = 0.1, 60


def satellite(p):
    return li.schemes.splitting(li.systems.gravity_gradient(p["inertia"], SATELLITE.orbit))


def step_of(name):
    system, state, dt = EXAMPLES[name]
    if name.startswith("euler"):
        return li.schemes.group_midpoint(system, li.maps.arcsine), state, dt
    return (li.schemes.so3_midpoint if name.startswith("rigid_body.") else li.schemes.splitting)(system), state, dt


@pytest.mark.parametrize(
    "name",
    [
        "gravity_gradient.satellite",
        "rigid_bodies.binary",
        "gyrostat.satellite",
        "group_potential.pulsating",
        "rigid_body.full_tensor",
    ],
)
def test_the_matrix_of_a_symplectic_step_is_symplectic(name):
    """Observed 3e-15 to 4e-14 of ω's largest element times that of Φ, squared, over 60 steps."""
    step, state, dt = step_of(name)
    found = li.transition(step, state, dt, STEPS, save_every=30)
    omega = step.system.phase_space.omega
    assert found.info.converged.all()
    np.testing.assert_array_equal(found.matrix[0], np.eye(step.system.phase_space.dim))
    for k in (1, 2):
        Phi, end = found.matrix[k], jax.tree.map(lambda x, k=k: x[k], found.state)
        defect = Phi.T @ omega(end) @ Phi - omega(state)
        scale = float(jnp.max(jnp.abs(Phi)) ** 2 * jnp.max(jnp.abs(omega(state))))
        assert float(jnp.max(jnp.abs(defect))) < 2e-13 * scale


def test_the_matrix_of_another_step_is_not_symplectic():
    body, state, dt = EXAMPLES["rigid_body.asymmetric"]
    step = li.schemes.so3_midpoint(body, li.maps.kappa_cayley)
    found = li.transition(step, state, dt, STEPS)
    omega = body.phase_space.omega
    defect = found.matrix.T @ omega(found.state) @ found.matrix - omega(state)
    assert float(jnp.max(jnp.abs(defect))) > 1e-4


def test_three_derivatives_of_a_driven_run_agree():
    """Against differences of sixth order (observed 1e-12 of the largest) and reverse mode by undoing steps (5e-15)."""
    space, J = SATELLITE.phase_space, SATELLITE.inertia
    found = li.transition(satellite, TILTED, DT, STEPS, parameters={"inertia": J})
    assert found.matrix.shape == (6, 6)
    assert found.by_parameters["inertia"].shape == (6, 3)

    @jax.jit
    def end_at(x):
        start = space.perturb(TILTED, x[:6])
        step = satellite({"inertia": J + x[6:]})
        run = li.integrate(step, start, DT, STEPS, save_every=STEPS, adjoint=li.ReversibleAdjoint())
        return space.displacement(found.state, jax.tree.map(lambda y: y[-1], run.state))

    derivative = np.concatenate([found.matrix, found.by_parameters["inertia"]], axis=1)
    size = np.abs(derivative).max()
    np.testing.assert_allclose(derivative, slopes(end_at, 9, 5e-4), rtol=0, atol=2e-11 * size)
    np.testing.assert_allclose(derivative, jax.jit(jax.jacrev(end_at))(jnp.zeros(9)), rtol=0, atol=1e-12 * size)
    run = li.integrate(satellite({"inertia": J}), TILTED, DT, STEPS)
    np.testing.assert_allclose(found.state.q, run.state.q[-1], rtol=0, atol=1e-13)
    assert float(found.t) == pytest.approx(float(TILTED.t) + DT * STEPS, abs=1e-13)


def test_names_stand_for_every_copy_of_a_number():
    """A splitting holds the inertia twice, in the system and in its drift; both vary."""
    step, values = li.schemes.splitting(TOP), {"inertia": TOP.inertia, "potential.weight": TOP.potential.weight}
    named = li.transition(step, SPINNING, DT, STEPS, parameters=list(values))

    def make_step(p):
        return li.schemes.splitting(li.systems.heavy_top(p["inertia"], p["potential.weight"]))

    function = li.transition(make_step, SPINNING, DT, STEPS, parameters=values)
    assert set(named.by_parameters) == set(values)
    for name in values:
        np.testing.assert_allclose(named.by_parameters[name], function.by_parameters[name], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(named.matrix, function.matrix)


def test_a_state_may_depend_on_the_parameters():
    """Of a body given by its angular velocity: ∂x(t)/∂p = S + Φ ∂x(0)/∂p."""
    step, Omega = li.schemes.splitting(TOP), jnp.array([0.4, 0.9, 0.6])

    def start(p):
        return TOP.state(SPINNING.q, angular_velocity=p)

    found = li.transition(step, start, DT, STEPS, parameters=Omega)
    fixed = li.transition(step, start(Omega), DT, STEPS)
    push = so3.to_matrix(SPINNING.q) * TOP.inertia
    expected = fixed.matrix @ jnp.concatenate([jnp.zeros((3, 3)), push])
    np.testing.assert_allclose(found.by_parameters, expected, rtol=0, atol=1e-12)


def test_extra_arrays_of_a_state_are_differentiated_too():
    """Wheels whose motors follow the body's rates; their momenta at the start are parameters. Observed 3e-12."""

    def motor(t, q, Omega, h):
        return 0.3 * Omega - 0.1 * h

    body = li.systems.torqued_body([1.0, 2.0, 2.5], li.torques.wheels(np.eye(3), 0.1, motor))
    step, space, state = (
        li.schemes.torqued_midpoint(body),
        body.phase_space,
        body.state(angular_velocity=[0.3, -0.4, 0.8]),
    )
    assert state.extra is not None
    found = li.transition(step, lambda h: state._replace(extra={"wheels": h}), DT, 20, parameters=state.extra["wheels"])

    @jax.jit
    def end_at(x):
        start = space.perturb(state, x[:6])._replace(extra={"wheels": state.extra["wheels"] + x[6:]})
        return space.displacement(found.state, jax.tree.map(lambda y: y[-1], li.integrate(step, start, DT, 20).state))

    derivative = np.concatenate([found.matrix, found.by_parameters], axis=1)
    np.testing.assert_allclose(derivative, slopes(end_at, 9, 5e-4), rtol=0, atol=2e-11)
    held = np.eye(6)
    for _ in range(20):  # the derivatives of single steps at held wheels are not those of the run
        state, _, held = step.tangent(state, DT, held)
    assert np.abs(held - found.matrix).max() > 1e-2


def test_covariance_and_ellipse_are_those_of_the_linear_map():
    step = li.schemes.splitting(TOP)
    found = li.transition(step, SPINNING, DT, STEPS, parameters="inertia", save_every=STEPS)
    P0, Pp = np.diag([1.0, 2, 3, 4, 5, 6]), np.array([[1.0, 0.5, 0], [0.5, 2, 0], [0, 0, 1]])
    P = found.covariance(P0, Pp)
    Phi, S = found.matrix[-1], found.by_parameters["inertia"][-1]
    np.testing.assert_allclose(P[-1], Phi @ P0 @ Phi.T + S @ Pp @ S.T, rtol=1e-13)
    np.testing.assert_array_equal(P[0], P0)
    ellipse = found.ellipse(P0, (1, 4), 2.0, parameter_covariance=Pp)
    np.testing.assert_allclose(ellipse.semi_axes[0], 2 * np.sqrt([5.0, 2.0]), rtol=1e-14)
    np.testing.assert_allclose(np.abs(ellipse.axes[0]), [[0, 1], [1, 0]], rtol=0, atol=1e-15)
    spread = ellipse.axes[-1] * (ellipse.semi_axes[-1] / 2) ** 2 @ ellipse.axes[-1].T
    np.testing.assert_allclose(spread, P[-1][np.ix_([1, 4], [1, 4])], rtol=1e-12)


def test_transition_can_be_vmapped_and_keeps_its_dtype():
    step, states = li.schemes.splitting(TOP), jax.tree.map(lambda x: jnp.stack([x, x]), SPINNING)
    states = states._replace(p=states.p * jnp.array([[1.0], [1.1]]))
    many = jax.jit(jax.vmap(lambda z: li.transition(step, z, DT, STEPS)))(states)
    with pytest.raises(ValueError, match="needs transition"):
        many.covariance(np.eye(6), np.eye(3))
    with pytest.raises(ValueError, match="initial must be a covariance of 6 coordinates"):
        many.covariance(np.eye(3))
    single = li.transition(step, State(states.q[1], states.p[1]), DT, STEPS)
    np.testing.assert_allclose(many.matrix[1], single.matrix, rtol=0, atol=1e-12)
    assert many.covariance(np.eye(6)).shape == (2, 6, 6)
    small = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (step, SPINNING))
    found = li.transition(*small, DT, 10, parameters="inertia")
    assert found.matrix.dtype == found.by_parameters["inertia"].dtype == jnp.float32


def test_bodies_of_uncertain_inertia_scatter_as_the_derivatives_predict():
    """Each of 200 clones, to the square of its deviation: observed 1.2e-5 of the largest displacement at 1e-5."""
    inertia, rate, dt, count = jnp.array([3.0836, 3.235, 1.0]), jnp.array([0.25, 0.59, -1.72]), 0.005, 400
    q = li.groups.so3.exp(jnp.array([0.3, -1.0, 0.7]))

    def body(x):
        second = (jnp.sum(inertia) / 2 - inertia) * jnp.exp(x)  # moments of mass along the axes
        return li.systems.rigid_body(jnp.sum(second) - second)

    def start(x):
        return body(x).state(q, angular_velocity=rate)

    x = 1e-5 * np.random.default_rng(4).normal(size=(200, 3))
    steps, states = jax.jit(jax.vmap(lambda x: (li.schemes.so3_midpoint(body(x)), start(x))))(x)
    run = li.run(steps, states, dt, count, save_every=count, own_step=True, progress=False)
    found = li.transition(lambda x: li.schemes.so3_midpoint(body(x)), start, dt, count, parameters=jnp.zeros(3))
    space, ends = body(jnp.zeros(3)).phase_space, jax.tree.map(lambda y: jnp.asarray(y[-1]), run.state)
    moved = np.asarray(jax.vmap(lambda z: space.displacement(found.state, z))(ends))
    predicted = x @ np.asarray(found.by_parameters).T
    assert abs(predicted).max() > 1e-6
    np.testing.assert_allclose(moved, predicted, rtol=0, atol=5e-5 * abs(predicted).max())
