"""Batches in which each member has a system of its own, which is measured with it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.core import State, StepInfo, Trajectory

pytestmark = pytest.mark.long

T = np.linspace(0, 2, 3)
RNG = np.random.default_rng(1)
SPREAD, RATES = RNG.uniform(0.5, 2.0, (9, 3)), RNG.normal(size=(9, 3))
BODY = li.systems.rigid_body([1.0, 2.0, 2.5])


@functools.cache
def batch(members, full=False):
    """Free bodies of their own inertia, each turning about its z axis: their systems, their run, and their energies."""
    J = (SPREAD**2).sum(1, keepdims=True)[:members] - SPREAD[:members] ** 2
    bodies = jax.vmap(li.systems.rigid_body)(jnp.asarray(J if not full else J[:, :, None] * np.eye(3)))
    rates = np.stack([0 * J[:, 0], 0 * J[:, 0], RATES[:members, 2]], axis=1)
    half = T[:, None] * rates[:, 2] / 2
    q = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    info = StepInfo(np.zeros((3, members)), np.ones((3, members), bool))
    run = Trajectory(T, State(q, np.tile(J * rates, (3, 1, 1))), info)
    return bodies, run, rates, (J * rates**2).sum(1) / 2


@pytest.mark.quick
@pytest.mark.parametrize(("members", "full"), [(5, False), (3, True), (3, False)])
def test_each_member_is_measured_with_its_own_system(members, full):
    """Three sets of moments (3, 3), too, which look like one tensor."""
    bodies, trajectory, rates, energies = batch(members, full)
    run = li.Run.of(jax.vmap(li.schemes.so3_midpoint)(bodies), trajectory, own_step=True)
    data = run.to_xarray()
    np.testing.assert_allclose(data.energy, np.broadcast_to(energies, (3, members)), rtol=2e-14)
    np.testing.assert_allclose(data.angular_velocity[0], rates, rtol=0, atol=1e-15)
    for name in ("energy_error", "momentum_error", "constraint_error"):
        error = np.asarray(getattr(run, name)())
        assert error.shape == (3, members, 3)[: 3 if name == "momentum_error" else 2]
        assert np.abs(error).max() < 2e-14  # observed: 4e-15


def test_a_shared_system_is_that_of_each_member():
    """Its inertia is a tensor, or moments (3,), as many as members."""
    _, trajectory, *_ = batch(3)
    for inertia in (np.diag([1.0, 2.0, 2.5]) + 0.1, [1.0, 2.0, 2.5]):
        run = li.Run.of(li.schemes.so3_midpoint(li.systems.rigid_body(inertia)), trajectory)
        shared = run.energy_error()
        assert shared.shape == (3, 3)
        np.testing.assert_allclose(shared, jnp.stack([run.member(k).energy_error() for k in range(3)], 1))


@pytest.mark.quick
def test_the_run_of_one_body_with_the_systems_of_all_is_refused():
    bodies, trajectory, *_ = batch(5)
    one = Trajectory(T, *jax.tree.map(lambda x: x[:, 0], (trajectory.state, trajectory.info)))
    with pytest.raises(ValueError, match="own_step"):
        li.Run.of(jax.vmap(li.schemes.so3_midpoint)(bodies), one)
    with pytest.raises(ValueError, match=r"inertia of one system is \(3,\).*got shape \(5, 3\)"):
        li.interpolate(bodies, one, [1.0])
    with pytest.raises(ValueError, match=r"got shape \(3, 3\), not symmetric"):
        li.interpolate(batch(3)[0], one, [1.0])


@pytest.mark.quick
@pytest.mark.parametrize("members", [3, 5])
def test_steps_with_a_member_axis_need_own_step(members):
    bodies, run, *_ = batch(members)
    states = jax.tree.map(lambda x: x[0], run.state)
    steps = jax.vmap(li.schemes.so3_explicit)(bodies)
    with pytest.raises(ValueError, match=r"own_step=True"):
        li.run(steps, states, 0.1, 2, progress=False, save_every=None)
    step = li.schemes.so3_explicit(BODY)
    if members != 3:
        with pytest.raises(ValueError, match=rf"a step for each of {members} members"):
            li.run(step, states, 0.1, 2, own_step=True, progress=False, save_every=None)


def test_a_vmapped_integrate_has_its_axes_the_other_way_round():
    _, trajectory, *_ = batch(5)
    turned = jax.tree.map(lambda x: np.swapaxes(x, 0, 1), (trajectory.state, trajectory.info))
    swapped, step = Trajectory(np.tile(T, (5, 1)), *turned), li.schemes.so3_midpoint(BODY)
    wrong = li.Run.of(step, swapped)
    for measure in (wrong.to_xarray, wrong.rotations):
        with pytest.raises(ValueError, match=r"\(member, time\).*li\.run.*out_axes"):
            measure()
    separate = jax.vmap(lambda x: li.Run.of(step, x).energy_error())(swapped)  # one by one they are right
    np.testing.assert_allclose(separate.T, li.Run.of(step, trajectory).energy_error(), rtol=0, atol=1e-15)


def test_what_the_message_about_vmap_advises_works():
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.asarray(RATES[:5]))
    step = li.schemes.so3_explicit(BODY)
    run = jax.vmap(lambda z: li.integrate(step, z, 0.1, 4), out_axes=Trajectory(None, 1, 1))(states)  # pyright: ignore
    assert dict(li.Run.of(step, run).to_xarray().sizes)["member"] == 5
    again = li.run(step, states, 0.1, 4, save_every=1, progress=False)
    np.testing.assert_allclose(run.state.q, again.state.q, rtol=0, atol=1e-15)


@pytest.mark.parametrize("members", [2, 6])
def test_members_have_metrics_of_their_own(members):
    """On SO(4), d = 6: six metrics (6,) have the shape of one full metric."""
    metrics = jnp.asarray(RNG.uniform(1.0, 2.0, (members, 6)))
    group = li.groups.special_orthogonal(4)
    steps = jax.vmap(lambda m: li.schemes.group_midpoint(li.systems.euler(group, m)))(metrics)
    states = jax.vmap(lambda s: s.system.state(velocity=jnp.arange(6.0)))(steps)
    run = Trajectory(np.zeros(1), jax.tree.map(lambda x: x[None], states), StepInfo(*np.zeros((2, 1, members))))
    expected = np.asarray(metrics) @ np.arange(6.0) ** 2 / 2
    np.testing.assert_allclose(li.Run.of(steps, run, own_step=True).to_xarray().energy[0], expected, rtol=1e-14)


def test_clusters_with_one_system_per_member():
    for members, n in ((4, 2), (3, 3)):
        masses, inertias = RNG.uniform(1, 2, (members, n)), RNG.uniform(1, 1.5, (members, n, 3))

        def clusters(m, J):
            return li.systems.rigid_bodies(m, J, li.potentials.point_masses(1.0, m))

        systems = jax.vmap(clusters)(jnp.asarray(masses), jnp.asarray(inertias))
        x = np.arange(3.0 * n).reshape(n, 3) ** 1.5
        states = jax.vmap(lambda s: s.state(x, velocities=np.ones((n, 3)), angular_velocities=np.ones((n, 3))))(systems)  # noqa: B023
        run = Trajectory(np.zeros(1), jax.tree.map(lambda z: z[None], states), StepInfo(*np.zeros((2, 1, members))))
        wanted = jax.vmap(lambda s, z: s.energy(z))(systems, states)
        steps = jax.vmap(li.schemes.splitting)(systems)
        np.testing.assert_allclose(li.Run.of(steps, run, own_step=True).to_xarray().energy[0], wanted, rtol=1e-14)
        with pytest.raises(ValueError, match="own_step=True"):
            li.run(steps, states, 0.1, 1, progress=False, save_every=None)
