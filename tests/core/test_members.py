"""Batches in which each member has a system of its own, which is measured with it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.core import State, StepInfo, Trajectory
from lieint_jax.diagnostics import constraint_error, energy_error, momentum_error

pytestmark = pytest.mark.long

T = np.linspace(0, 2, 3)
RNG = np.random.default_rng(1)
SPREAD, RATES = RNG.uniform(0.5, 2.0, (9, 3)), RNG.normal(size=(9, 3))
OFF = {"energy_error": energy_error, "momentum_error": momentum_error, "constraint_error": constraint_error}


@functools.cache
def batch(members, full=False):
    """Free bodies of their own inertia, each turning about its z axis: their systems, their run, and their energies."""
    J = (SPREAD**2).sum(1, keepdims=True)[:members] - SPREAD[:members] ** 2
    bodies = jax.vmap(li.systems.RigidBody)(jnp.asarray(J if not full else J[:, :, None] * np.eye(3)))
    rates = np.stack([0 * J[:, 0], 0 * J[:, 0], RATES[:members, 2]], axis=1)
    half = T[:, None] * rates[:, 2] / 2
    q = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    info = StepInfo(np.zeros((3, members)), np.ones((3, members), bool))
    run = Trajectory(T, State(q, np.tile(J * rates, (3, 1, 1))), info)
    return bodies, run, rates, (J * rates**2).sum(1) / 2


@pytest.mark.parametrize(("members", "full", "axis"), [(5, False, "auto"), (3, True, "auto"), (3, False, 0)])
def test_each_member_is_measured_with_its_own_system(members, full, axis):
    bodies, run, rates, energies = batch(members, full)
    data = run.to_xarray(bodies, system_axis=axis)
    np.testing.assert_allclose(data.energy, np.broadcast_to(energies, (3, members)), rtol=2e-14)
    np.testing.assert_allclose(data.angular_velocity[0], rates, rtol=0, atol=1e-15)
    for name, off in OFF.items():
        error = np.asarray(off(bodies, run, system_axis=axis))
        assert error.shape == (3, members, 3)[: 3 if name == "momentum_error" else 2]
        assert np.abs(error).max() < 2e-14  # observed: 4e-15


@pytest.mark.quick
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_a_square_inertia_is_one_tensor_or_three_sets_of_moments_by_its_values(wrap):
    """Moments in rows are no tensor: they are not symmetric, or (of equal rows of equal moments) singular."""
    bodies, run, *_ = batch(3)
    spheres = jax.vmap(li.systems.RigidBody)(jnp.full((3, 3), 2.0))
    tensor = li.systems.rigid_body(np.diag([1.0, 2.0, 2.5]) + 0.1)
    faster = run.state._replace(p=run.state.p * np.arange(1.0, 4.0)[:, None, None])  # so that the energy changes
    run = run._replace(state=faster)
    measure = wrap(lambda system: energy_error(system, run))
    for system, axis in ((bodies, 0), (spheres, 0), (tensor, None)):
        expected = energy_error(system, run, system_axis=axis)
        np.testing.assert_allclose(measure(system), expected, rtol=0, atol=1e-14)  # observed: 5e-15, of 12
        assert expected.shape == (3, 3)
    wrong = energy_error(bodies, run, system_axis=None)
    assert np.abs(wrong).max() > 1e-2  # as a tensor, the moments of the three have another energy


def test_a_shared_system_is_that_of_each_member():
    _, run, *_ = batch(3)
    tensor = li.systems.rigid_body(np.diag([1.0, 2.0, 2.5]))
    shared = energy_error(tensor, run, system_axis=None)
    assert shared.shape == (3, 3)
    apart = jax.vmap(lambda z: energy_error(tensor, Trajectory(T, z, None)), 1, 1)
    np.testing.assert_allclose(shared, apart(run.state))


def test_one_system_of_all_members_stays_so():
    _, run, *_ = batch(3)
    body = li.systems.rigid_body([1.0, 2.0, 2.5])  # of shape (3,), as many as members
    assert energy_error(body, run).shape == (3, 3)


def test_contradictions_and_what_is_not_an_axis_are_refused():
    bodies, run, *_ = batch(5)
    body, others = li.systems.rigid_body([1.0, 2.0, 2.5]), batch(9)[0]
    for system, axis, words in (
        (bodies, None, r"there is one system per member.*\(5, 3\).*system_axis=0"),
        (body, 0, r"system_axis=0 needs a system for each member.*got 5 members.*\(3,\).*system_axis=None"),
        (bodies, 1, r"system_axis must be None .*or \"auto\", got 1"),
        (others, "auto", r"shape \(3,\) or \(3, 3\), got \(9, 3\).*system_axis=0"),
        (others, 0, r"got 5 members, and leaves of shapes \(9, 3\)"),
    ):
        with pytest.raises(ValueError, match=words):
            run.to_xarray(system, system_axis=axis)
        with pytest.raises(ValueError, match=words):
            energy_error(system, run, system_axis=axis)


def systems_and_run(k=0, members=5):
    bodies, run, *_ = batch(members)
    return bodies, Trajectory(run.t, *jax.tree.map(lambda x: x[:, k], (run.state, run.info)))


@pytest.mark.quick
def test_the_run_of_one_body_with_the_systems_of_all_is_refused():
    bodies, run = systems_and_run()
    for measure in (run.to_xarray, lambda system: energy_error(system, run)):
        with pytest.raises(ValueError, match="the run is of one body, but the system has a member axis of 5"):
            measure(bodies)
    with pytest.raises(ValueError, match="this run is of one body, got system_axis=0"):
        energy_error(bodies, run, system_axis=0)
    with pytest.raises(ValueError, match=r"inertia of one system is \(3,\).*got shape \(5, 3\)"):
        li.interpolate(bodies, run, [1.0])
    with pytest.raises(ValueError, match=r"got shape \(3, 3\), not symmetric"):
        li.interpolate(systems_and_run(members=3)[0], run, [1.0])


@pytest.mark.quick
@pytest.mark.parametrize("members", [3, 5])
def test_steps_with_a_member_axis_need_own_step(members):
    bodies, run, *_ = batch(members)
    states = jax.tree.map(lambda x: x[0], run.state)
    steps = jax.vmap(li.schemes.so3_explicit)(bodies)
    with pytest.raises(ValueError, match=r"own_step=True"):
        li.run(steps, states, 0.1, 2, progress=False, save_every=None)
    step = li.schemes.so3_explicit(li.systems.rigid_body([1.0, 2.0, 2.5]))
    if members != 3:
        with pytest.raises(ValueError, match=rf"a step for each of {members} members"):
            li.run(step, states, 0.1, 2, own_step=True, progress=False, save_every=None)


def test_a_vmapped_integrate_has_its_axes_the_other_way_round():
    _, run, *_ = batch(5)
    turned = jax.tree.map(lambda x: np.swapaxes(x, 0, 1), (run.state, run.info))
    wrong = Trajectory(np.tile(T, (5, 1)), *turned)
    body = li.systems.rigid_body([1.0, 2.0, 2.5])
    for measure in (wrong.to_xarray, wrong.rotations, lambda: energy_error(body, wrong)):
        with pytest.raises(ValueError, match=r"\(member, time\).*li\.run.*out_axes"):
            measure()
    apart = jax.vmap(functools.partial(energy_error, body))(wrong)  # one by one they are right
    np.testing.assert_allclose(apart.T, energy_error(body, run), rtol=0, atol=1e-15)


def test_what_the_message_about_vmap_advises_works():
    body = li.systems.rigid_body([1.0, 2.0, 2.5])
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(jnp.asarray(RATES[:5]))
    step = li.schemes.so3_explicit(body)
    run = jax.vmap(lambda z: li.integrate(step, z, 0.1, 4), out_axes=Trajectory(None, 1, 1))(states)  # pyright: ignore
    assert dict(run.to_xarray(body).sizes)["member"] == 5
    again = li.run(step, states, 0.1, 4, save_every=1, progress=False)
    np.testing.assert_allclose(run.state.q, again.state.q, rtol=0, atol=1e-15)


@pytest.mark.parametrize("members", [2, 6])
def test_metrics_of_members_are_distinguished_from_a_full_metric(members):
    """On SO(4), d = 6: six metrics (6,) have the shape of one full metric."""
    metrics = jnp.asarray(RNG.uniform(1.0, 2.0, (members, 6)))
    group = li.groups.special_orthogonal(4)
    systems = jax.vmap(lambda m: li.systems.euler(group, m))(metrics)
    states = jax.vmap(lambda s: s.state(velocity=jnp.arange(6.0)))(systems)
    run = Trajectory(np.zeros(1), jax.tree.map(lambda x: x[None], states), StepInfo(*np.zeros((2, 1, members))))
    expected = np.asarray(metrics) @ np.arange(6.0) ** 2 / 2
    np.testing.assert_allclose(run.to_xarray(systems).energy[0], expected, rtol=1e-14)


def test_clusters_with_one_system_per_member():
    """Three members of three bodies are recognized by the ranks of the leaves."""
    for members, n in ((4, 2), (3, 3)):
        masses, inertias = RNG.uniform(1, 2, (members, n)), RNG.uniform(1, 1.5, (members, n, 3))

        def clusters(m, J):
            return li.systems.rigid_bodies(m, J, li.potentials.point_masses(1.0, m))

        systems = jax.vmap(clusters)(jnp.asarray(masses), jnp.asarray(inertias))
        x = np.arange(3.0 * n).reshape(n, 3) ** 1.5
        states = jax.vmap(lambda s: s.state(x, velocities=np.ones((n, 3)), angular_velocities=np.ones((n, 3))))(systems)  # noqa: B023
        run = Trajectory(np.zeros(1), jax.tree.map(lambda z: z[None], states), StepInfo(*np.zeros((2, 1, members))))
        wanted = jax.vmap(lambda s, z: s.energy(z))(systems, states)
        np.testing.assert_allclose(run.to_xarray(systems).energy[0], wanted, rtol=1e-14)
        with pytest.raises(ValueError, match="own_step=True"):
            li.run(jax.vmap(li.schemes.splitting)(systems), states, 0.1, 1, progress=False, save_every=None)
