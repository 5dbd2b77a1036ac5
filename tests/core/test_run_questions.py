"""A run answers by name what people ask first, in memory and on disk; scipy's rotations are the reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
QUIET = {"progress": False}


def one():
    start = BODY.state(attitude=[0.5, 0.5, -0.5, 0.5], angular_velocity=[0.2, -0.4, 0.7])
    return li.run(li.schemes.so3_midpoint(BODY), start, 0.05, 60, save_every=6, **QUIET)


def batch(store=None):
    rates = np.random.default_rng(3).normal(size=(3, 3))
    states = jax.vmap(lambda w: BODY.state(attitude=[0.5, 0.5, -0.5, 0.5], angular_velocity=w))(rates)
    return li.run(li.schemes.so3_midpoint(BODY), states, 0.05, 60, save_every=6, store=store, **QUIET)


def drag(t, q, omega):
    return -0.1 * omega


def own_law():
    body = li.systems.torqued_body([1.0, 2.0, 3.0], drag)
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.eye(3))
    return li.run(li.schemes.torqued_midpoint(body), states, 0.05, 60, save_every=6, **QUIET)


RUNS = {"one body": one, "a batch": batch, "a law of the user's": own_law}


@pytest.mark.parametrize("name", RUNS)
def test_attitudes_and_rates_are_those_of_scipy(name):
    run = RUNS[name]()
    q, shape = np.asarray(run.state.q), run.state.q.shape[:-1]
    turns = Rotation.from_quat(np.roll(q.reshape(-1, 4), -1, axis=1))
    np.testing.assert_allclose(run.matrices(), turns.as_matrix().reshape(*shape, 3, 3), rtol=0, atol=1e-15)
    for sequence in ("ZYX", "zxz"):
        R = Rotation.from_euler(sequence, np.array(run.euler(sequence)).reshape(-1, 3))
        assert (R.inv() * turns).magnitude().max() < 3e-15
    vector = np.array([0.3, -1.0, 2.0])
    np.testing.assert_allclose(run.rotate(vector), turns.apply(vector).reshape(*shape, 3), rtol=0, atol=2e-15)
    body, space = np.array(run.angular_velocity()), np.asarray(run.angular_velocity(frame="space"))
    np.testing.assert_allclose(space, turns.apply(body.reshape(-1, 3)).reshape(*shape, 3), rtol=0, atol=2e-15)
    J = np.array([1.0, 2.0, 3.0])  # π = Λ J Ω, and H = Ω·JΩ/2
    np.testing.assert_allclose(
        turns.apply((J * body).reshape(-1, 3)).reshape(*shape, 3), run.state.p, rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(run.energy(), (J * body**2).sum(axis=-1) / 2, rtol=1e-14)


def test_a_run_on_disk_answers_the_same(tmp_path):
    memory, disk = batch(), batch(tmp_path / "run.zarr")
    for ask in (
        lambda run: run.energy(),
        lambda run: run.angular_velocity("space"),
        lambda run: run.matrices(),
        lambda run: run.euler("ZYX"),
        lambda run: run.rotate([0.0, 0.0, 1.0]),
    ):
        np.testing.assert_array_equal(ask(memory), ask(disk))


def test_several_bodies_have_an_axis_of_bodies():
    V = li.potentials.point_masses(1.0, [2.0, 1.0])
    bodies = li.systems.rigid_bodies([2.0, 1.0], [[0.5, 0.6, 0.7], [0.1, 0.2, 0.2]], V)
    state = bodies.state([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], angular_velocities=[[0.0, 0.1, 1.0], [0.5, 0.0, 0.3]])
    run = li.run(li.schemes.splitting(bodies), state, 0.05, 4, **QUIET)
    assert run.angular_velocity().shape == run.rotate([1.0, 0.0, 0.0]).shape == run.euler("ZYX").shape == (5, 2, 3)
    np.testing.assert_allclose(run.angular_velocity()[0], [[0.0, 0.1, 1.0], [0.5, 0.0, 0.3]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(run.matrices()[..., 0], run.rotate([1.0, 0.0, 0.0]), rtol=0, atol=1e-15)


def test_a_system_without_attitudes_says_so():
    bob = li.systems.pendulum(1.0, 9.81, [0.0, 0.0, -1.0])
    start = bob.state([0.0, 0.6, -0.8], velocity=[0.1, 0.0, 0.0])
    run = li.run(li.schemes.sphere_midpoint(bob), start, 0.05, 4, **QUIET)
    with pytest.raises(ValueError, match=r"Pendulum has no attitudes: its q has the shape \(3,\)"):
        run.matrices()
    with pytest.raises(ValueError, match='frame must be "body" or "space", got \'inertial\''):
        one().angular_velocity("inertial")


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("q", "run.state.q"),
        ("to_pandas", r"run\.to_dataframe\(\)"),
        ("omega", r"run\.angular_velocity\(\)"),
        ("states", r"run\.state"),
    ],
)
def test_what_a_run_does_not_have_is_named_by_what_it_has(name, way):
    with pytest.raises(AttributeError, match=f"a Run has no '{name}': see {way}"):
        getattr(one(), name)


def test_arguments_of_other_packages_and_in_another_order_are_explained():
    step, state = li.schemes.so3_midpoint(BODY), BODY.state(angular_velocity=[0.2, -0.4, 0.7])
    for function, name in ((li.run, "li.run"), (li.integrate, "li.integrate")):
        with pytest.raises(TypeError, match=rf"{name} has no argument 't_end': give num_steps, such as round\(t_end"):
            function(step, state, 0.1, t_end=1.0)
        with pytest.raises(TypeError, match=rf"{name} has no argument 'save_evry': give save_every"):
            function(step, state, 0.1, 10, save_evry=1)
        with pytest.raises(ValueError, match=rf"the step comes first: {name}\(step, state, dt, num_steps\)"):
            function(state, step, 0.1, 10)
        with pytest.raises(ValueError, match="dt comes before num_steps"):
            function(step, state, 10, 0.1)


@pytest.mark.long
def test_a_run_draws_itself(tmp_path):
    run = batch()
    assert run.plot("a body").get_suptitle() == "a body"
    assert run.animate(tmp_path / "x.gif", seconds=0.3, fps=10).read_bytes().startswith(b"GIF8")


def test_a_run_is_still_a_pytree():
    run = one()
    assert float(jax.jit(lambda r: jnp.sum(r.state.p))(run)) == pytest.approx(float(run.state.p.sum()))


def test_inertias_that_were_made_inside_vmap_are_checked_where_a_run_begins():
    def member(J):
        body = li.systems.rigid_body(J)
        return li.schemes.so3_midpoint(body), body.state(angular_velocity=jnp.array([0.1, 0.2, 0.3]))

    J = np.array([[1.0, 2.0, 2.5], [-1.0, -2.0, -2.5]])
    for values in (J, np.stack([np.diag(x) for x in J])):
        step, states = jax.jit(jax.vmap(member))(values)
        with pytest.raises(ValueError, match="inertia of member 1 must be positive definite, got"):
            li.run(step, states, 0.1, 4, own_step=True, **QUIET)
    step, state = jax.jit(member)(J[1])
    for function in (li.run, li.integrate):
        with pytest.raises(ValueError, match="inertia must be positive definite, got"):
            function(step, state, 0.1, 4)


def test_masses_that_were_made_inside_jit_are_checked_where_a_run_begins():
    def pair(masses):
        bodies = li.systems.rigid_bodies(masses, np.ones((2, 3)), lambda x, R: jnp.sum(x**2))
        return li.schemes.splitting(bodies), bodies.state([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])

    step, state = jax.jit(pair)(jnp.array([1.0, -1.0]))
    with pytest.raises(ValueError, match="masses must be positive, got"):
        li.run(step, state, 0.1, 4, **QUIET)


def test_a_metric_of_rotations_and_translations_in_distant_units_is_no_negative_one():
    """Positive definite at any unit: its least eigenvalue, 1e-18, is below the rounding of the largest, 1e11."""
    A = np.random.default_rng(0).normal(size=(6, 6))
    unit = np.array([1e-9] * 3 + [1e5] * 3)
    metric = (A @ A.T + 6 * np.eye(6)) * unit * unit[:, None]
    assert np.linalg.eigvalsh(metric)[0] < 0
    body = li.systems.euler(li.groups.special_euclidean(3), metric)
    step = li.schemes.group_midpoint(body)
    run = li.run(step, body.state(velocity=jnp.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0])), 0.05, 4, **QUIET)
    assert np.isfinite(run.state.p).all()
    wrong = li.systems.euler(body.group, np.eye(6))
    step = jax.jit(lambda sign: li.schemes.group_midpoint(li.systems.euler(wrong.group, sign * jnp.asarray(metric))))(
        -1.0
    )
    with pytest.raises(ValueError, match="metric must be positive definite"):
        li.run(step, wrong.state(velocity=jnp.ones(6)), 0.05, 4, **QUIET)
