"""A run is one noun: of one body or many, in memory or on disk; what it answers is checked against other ways."""

import internals
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import steps
from hypothesis import given, settings
from hypothesis import strategies as st

import lieint_jax as li

J123 = np.array([1.0, 2.0, 3.0])
BODY = li.systems.rigid_body(J123)
STEP = li.schemes.so3_midpoint(BODY, kappa=li.maps.kappa_symplectic)
ONE = BODY.state(attitude=[0.5, 0.5, -0.5, 0.5], angular_velocity=[0.2, -0.4, 0.7])
SATELLITE = li.schemes.torqued_midpoint(li.systems.torqued_body(J123, li.torques.viscous(0.1)))
QUIET = {"progress": False}


def bodies(members, seed=1, system=BODY, **more):
    Omega = np.random.default_rng(seed).normal(size=(members, 3)) * 0.4
    return jax.vmap(lambda w: system.state(attitude=[1, 0, 0, 0], angular_velocity=w, **more))(Omega)


def satellites(members):
    return bodies(members, system=SATELLITE.system, t=0.0, work=0.0)


def speed(step, state):
    return jnp.linalg.norm(step.system.angular_velocity(state))


def is_slow(step, state):
    return speed(step, state) < 0.3


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_a_run_of_one_body_is_integrate_to_the_bit_and_knows_its_step():
    run = li.run(STEP, ONE, 0.05, 120, save_every=3, **QUIET)
    same(run.trajectory, jax.tree.map(np.asarray, li.integrate(STEP, ONE, 0.05, 120, save_every=3)))
    assert (run.members, run.dt, run.own_step, run.engine) == (None, 0.05, False, "native")
    assert run.step.system is run.system
    assert run.converged.shape == ()
    assert run.converged
    assert set(run.versions) == {"lieint_jax", "jax", "jaxlib", "numpy"}


def test_a_batch_has_the_axes_time_and_member_and_its_members_are_runs():
    batch = bodies(5)
    run = li.run(STEP, batch, 0.05, 40, save_every=4, **QUIET)
    assert run.members == 5
    assert run.state.q.shape == (11, 5, 4)
    assert run.converged.shape == run.failed.shape == (5,)
    for k in (0, 4, -1):
        member = run.member(k)
        alone = li.run(STEP, jax.tree.map(lambda x: x[k], batch), 0.05, 40, save_every=4, **QUIET)  # noqa: B023
        same(member.trajectory, alone.trajectory)
        assert member.members is None
    for k in (5, 1.5):
        with pytest.raises(ValueError, match=f"the run has 5 members, numbered from 0, got {k}"):
            run.member(k)
    with pytest.raises(ValueError, match="is of one body"):
        run.member(0).member(0)


@jax.jit
def energies(system, states):
    return jax.vmap(system.energy)(states)


def test_each_of_three_members_with_an_inertia_of_its_own_needs_no_more_than_to_be_said_so():
    """An inertia (3, 3) is one tensor, or the moments of each of three members: here the run knows."""
    J = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [1.0, 1.5, 2.0]])
    own = jax.vmap(lambda J: li.schemes.so3_midpoint(li.systems.rigid_body(J)))(J)
    run = li.run(own, bodies(3), 0.05, 40, save_every=4, own_step=True, **QUIET)
    for k in range(3):
        system = li.systems.rigid_body(J[k])
        z = jax.tree.map(lambda x: x[:, k], run.state)  # noqa: B023
        energy = np.asarray(energies(system, z))
        np.testing.assert_allclose(run.energy_error()[:, k], energy - energy[0], rtol=0, atol=1e-15)
        np.testing.assert_allclose(run.member(k).system.inertia, J[k], rtol=1e-15)
        np.testing.assert_allclose(run.to_xarray().energy[:, k], energy, rtol=1e-15)
    table = run.to_dataframe()
    assert len(table) == 11 * 3
    np.testing.assert_allclose(table["energy"][table.member == 1], run.to_xarray().energy[:, 1], rtol=1e-15)
    np.testing.assert_array_equal(table["p_z"], np.ravel(run.state.p[:, :, 2]))
    assert run.periods().precession.shape == (11, 3)
    assert run.at([0.1, 0.33]).q.shape == (2, 3, 4)


def test_a_run_knows_what_it_conserves_and_its_attitudes():
    run = li.run(STEP, bodies(4), 0.05, 60, save_every=6, **QUIET)
    for name in ("energy_error", "momentum_error", "constraint_error"):
        assert np.abs(getattr(run, name)()).max() < 5e-15  # observed: 1e-15
    np.testing.assert_allclose(run.rotations().as_quat()[..., 3], run.state.q[..., 0], rtol=0, atol=4e-16)


def test_a_run_of_known_states_answers_like_the_one_that_made_them():
    """Of one body, of many, and inside jit; it does not know its steps, so that it cannot be extended."""
    run = li.run(STEP, bodies(4), 0.05, 60, save_every=6, **QUIET)
    known = li.Run.of(STEP, run.trajectory)
    np.testing.assert_array_equal(known.energy_error(), run.energy_error())
    np.testing.assert_array_equal(known.member(2).state.q, run.state.q[:, 2])
    assert known.members == 4
    assert known.converged.all()
    assert "11 saves" in repr(known)
    assert "given times" not in repr(known)
    with pytest.raises(ValueError, match="a run at given times cannot be extended"):
        known.extend(6)
    start = jax.tree.map(lambda x: x[0], bodies(4))
    error = jax.jit(lambda z: li.Run.of(STEP, li.integrate(STEP, z, 0.05, 60)).energy_error())(start)
    assert error.shape == (61,)
    assert np.abs(error).max() < 5e-15  # observed: 1e-15
    failed = run.trajectory._replace(info=run.info._replace(converged=np.asarray(run.info.converged).copy()))
    failed.info.converged[3:, 1] = False
    assert li.Run.of(STEP, failed).failed.tolist() == [-1, 2, -1, -1]
    with pytest.raises(ValueError, match="states of RigidBody have q of shape"):
        li.Run.of(STEP, jax.tree.map(lambda x: x[:, None], run.trajectory))


@pytest.mark.long
def test_states_between_the_saves_are_near_the_exact_ones():
    step = li.schemes.exact(BODY)
    run, times = li.run(step, bodies(3), 0.05, 100, **QUIET), np.array([0.0, 1.234, 4.999, 0.0251])
    found = run.at(times)
    for k in range(3):
        exact = jax.vmap(lambda t: BODY.solution(jax.tree.map(lambda x: x[0, k], run.state), t))(times)  # noqa: B023
        np.testing.assert_allclose(found.q[:, k], exact.q, rtol=0, atol=1e-9)  # O(h⁶); observed: 5e-11
        np.testing.assert_allclose(run.member(k).at(times).q, found.q[:, k], rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="times must lie in the trajectory"):
        run.at([6.0])
    with pytest.raises(ValueError, match="too far apart to interpolate"):
        li.run(step, bodies(3), 0.05, 1000, save_every=500, **QUIET).at([1.0])
    lost = jax.tree.map(lambda x: x.at[50:, 1].set(jnp.nan), jax.tree.map(jnp.asarray, run.state))  # one member fails
    after = li.Run.of(step, li.Trajectory(run.t, lost, run.info)).at(times)
    np.testing.assert_array_equal(
        np.isnan(after.q).any(axis=2), [[False] * 3, [False] * 3, [False, True, False], [False] * 3]
    )
    np.testing.assert_array_equal(after.q[:, 2], found.q[:, 2])


@pytest.mark.long
def test_members_that_start_at_different_times_are_interpolated_since_the_start():
    top = li.systems.driven_top(J123, lambda gamma, t: jnp.cos(t) * gamma[2])
    step, t0 = li.schemes.splitting(top), np.array([0.0, 2.0])
    states = jax.vmap(lambda t: top.state(attitude=[1, 0, 0, 0], angular_velocity=[0.3, 0.1, 0.2], t=t))(t0)
    run = li.run(step, states, 0.02, 100, save_every=5, **QUIET)
    found, direct = run.at([0.333]), li.run(step, states, 0.02, 100, save_at=[0.333], **QUIET)
    np.testing.assert_allclose(found.t[0], t0 + 0.333, rtol=1e-15)
    np.testing.assert_allclose(found.p[0], direct.state.p[1], rtol=0, atol=1e-6)  # a step's error; observed: 2e-7


@settings(max_examples=8, deadline=None)
@given(first=st.integers(0, 12), more=st.integers(0, 12), seed=st.integers(0, 99))
def test_a_run_that_is_extended_is_the_whole_run_bit_for_bit(first, more, seed):
    batch = bodies(3, seed)
    parts = li.run(STEP, batch, 0.05, 4 * first, save_every=4, **QUIET).extend(4 * more, **QUIET)
    same(parts, li.run(STEP, batch, 0.05, 4 * (first + more), save_every=4, **QUIET))


EXTENDED = [
    pytest.param({"save_every": 10}, id="states"),
    pytest.param({"reduce": "energy", "save_every": 10}, id="changes", marks=pytest.mark.long),
    pytest.param({"reduce": speed, "per": "member"}, id="members", marks=pytest.mark.long),
    pytest.param({"reduce": speed, "per": "member", "first": is_slow}, id="first", marks=pytest.mark.long),
]


@pytest.mark.parametrize("options", EXTENDED)
def test_runs_of_one_body_and_of_many_are_extended_saved_and_opened(options, tmp_path):
    for name, states in (("many", satellites(4)), ("one", jax.tree.map(lambda x: x[0], satellites(1)))):
        whole = li.run(SATELLITE, states, 0.05, 60, **options, **QUIET)
        same(li.run(SATELLITE, states, 0.05, 20, **options, **QUIET).extend(40, **QUIET), whole)
        path = tmp_path / f"{name}.zarr"
        whole.save(path)
        again, computed = (
            li.open(path),
            li.run(SATELLITE, states, 0.05, 60, **options, **QUIET, store=path, resume=True),
        )
        for run in (again, computed):
            same((run.trajectory, run.summary, run.failed), (whole.trajectory, whole.summary, whole.failed))
            assert run.members == whole.members
            assert run.engine == whole.engine
        assert jax.tree.structure(again.step) == jax.tree.structure(whole.step)
        file = whole.save(tmp_path / f"{name}.zip")
        for run in (file, li.open(tmp_path / f"{name}.zip")):
            same((run.trajectory, run.summary, run.failed), (whole.trajectory, whole.summary, whole.failed))
        for taken in (path, tmp_path / f"{name}.zip"):
            with pytest.raises(ValueError, match="exists and is not overwritten"):
                whole.save(taken)
        assert [x.name for x in tmp_path.iterdir() if x.name.startswith(".")] == []


def test_an_opened_run_answers_like_the_one_in_memory_and_goes_on(tmp_path):
    run = li.run(STEP, bodies(3), 0.05, 40, save_every=4, **QUIET)
    stored = li.run(STEP, bodies(3), 0.05, 40, save_every=4, **QUIET, store=tmp_path / "a.zarr")
    opened = li.open(tmp_path / "a.zarr")
    for found in (stored, opened):
        np.testing.assert_array_equal(found.energy_error(), run.energy_error())
        np.testing.assert_array_equal(found.at([0.3]).q, run.at([0.3]).q)
        same(found.member(1).trajectory, run.member(1).trajectory)
        with pytest.raises(ValueError, match=r"bring it to memory first, run\.load\(\)\.extend\(8\)"):
            found.extend(8)
        same(found.load().extend(8, **QUIET).trajectory, run.extend(8, **QUIET).trajectory)
        assert "a.zarr" in repr(found)
        with pytest.raises(TypeError, match="StoredRun"):
            jax.jit(lambda run: run.state.q)(found)
    inside = jax.jit(lambda r: r.energy_error())(opened.load())
    np.testing.assert_allclose(inside, run.energy_error(), rtol=0, atol=1e-15)  # observed: 2e-16


def test_values_along_a_run_on_disk_are_read_in_blocks(tmp_path, monkeypatch):
    internals.read_few_rows(monkeypatch, 300)  # bytes, of 168 in a row
    run = li.run(STEP, bodies(3), 0.05, 40, save_every=4, **QUIET, store=tmp_path / "a.zarr")
    found = run.map(lambda step, z: {"H": step.system.energy(z), "p": z.p})
    np.testing.assert_array_equal(found["p"], run.state.p[...])
    assert found["H"].shape == (11, 3)


def test_failures_are_told_by_member_and_step(tmp_path):
    batch, step = bodies(4), li.schemes.so3_midpoint(BODY, iterations=8)
    q, p = np.array(batch.q), np.array(batch.p)
    q[2], p[2] = [1.0, 0, 0, 0], J123 * [0.0, 1.0, 1e-4]  # about the intermediate axis: Ω grows in the flip
    batch = batch._replace(q=jnp.array(q), p=jnp.array(p))
    with pytest.warns(RuntimeWarning, match="1 of 4 members did not converge"):
        run = li.run(step, batch, 0.99, 100, **QUIET)
    first = int(np.argmin(run.info.converged[:, 2])) - 1
    np.testing.assert_array_equal(run.failed, [-1, -1, first, -1])
    np.testing.assert_array_equal(run.converged, [True, True, False, True])
    assert f"not 1 member(s): 2; first member 2 at step {first}" in repr(run)
    run.save(tmp_path / "a.zarr")
    np.testing.assert_array_equal(li.open(tmp_path / "a.zarr").failed, run.failed)
    with pytest.warns(RuntimeWarning, match="1 of 4 members did not converge"):
        longer = li.run(step, batch, 0.99, first + 1, **QUIET).extend(2, **QUIET)
    np.testing.assert_array_equal(longer.failed, run.failed)


@pytest.mark.filterwarnings("ignore:the time 15 of a state")  # in float32
@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.long)])
def test_reductions_of_each_member_are_those_of_all_its_states(dtype):
    step = jax.tree.map(lambda x: jnp.asarray(x, dtype), SATELLITE)
    states = jax.tree.map(lambda x: jnp.asarray(x, dtype), satellites(17))
    found = li.run(step, states, 0.05, 300, reduce=speed, per="member", first=is_slow, **QUIET).summary
    every = li.run(step, states, 0.05, 300, **QUIET)
    v, tolerance = np.asarray(every.map(speed)), 4 * np.finfo(dtype).eps  # observed: 1 eps
    np.testing.assert_allclose(found.least, v.min(axis=0), rtol=tolerance)
    np.testing.assert_allclose(found.greatest, v.max(axis=0), rtol=tolerance)
    np.testing.assert_allclose(found.mean, v.mean(axis=0, dtype=np.float64), rtol=100 * tolerance)
    np.testing.assert_allclose(found.last, v[-1], rtol=tolerance)
    slow = np.asarray(every.map(is_slow))
    first = np.where(slow.any(axis=0), every.t[slow.argmax(axis=0)], np.nan)
    assert 0 < np.isnan(first).sum() < 17
    assert (first == 0).any()
    np.testing.assert_array_equal(found.first, first)
    np.testing.assert_array_equal(found.t, every.t[[0, -1]])
    same(found.state, jax.tree.map(lambda x: x[-1], every.state))


def above_1000(step, state):
    return 1000 + step.system.body_momentum(state)[0]


@pytest.mark.filterwarnings("ignore:the time 5000 of a state")  # in float32
def test_the_mean_of_many_values_has_the_digits_of_one():
    """Plain sums of 10⁵ values in float32 are off by 1e-3, and means are beyond the greatest value."""
    step, one = jax.tree.map(lambda x: jnp.asarray(x, np.float32), (STEP, ONE))
    found = li.run(step, one, 0.05, 100_000, reduce=above_1000, per="member", **QUIET).summary
    every = li.run(step, one, 0.05, 100_000, **QUIET)
    exact = np.asarray(every.map(above_1000)).mean(dtype=np.float64)
    assert abs(found.mean - exact) < 4 * np.finfo(np.float32).eps * exact  # observed: 0.5 eps


@pytest.mark.long
def test_reductions_of_each_member_have_the_same_bits_in_parts_and_by_any_threads(tmp_path):
    states, options = satellites(21), {"reduce": speed, "per": "member", "first": is_slow, **QUIET}
    whole = li.run(SATELLITE, states, 0.05, 100, **options)
    same(li.run(SATELLITE, states, 0.05, 100, **options, threads=1).summary, whole.summary)
    for k in range(3):
        part = li.run(SATELLITE, states, 0.05, 100, **options, store=tmp_path / "a.zarr", part=(k, 3))
        assert part.members == 7
    same(li.open(tmp_path / "a.zarr").summary, whole.summary)


def test_members_of_parts_that_are_missing_have_not_failed(tmp_path):
    li.run(STEP, bodies(6), 0.05, 40, save_every=4, **QUIET, store=tmp_path / "a.zarr", part=(1, 2))
    with pytest.warns(RuntimeWarning, match="part 0"):
        run = li.open(tmp_path / "a.zarr")
    np.testing.assert_array_equal(run.failed, [-1] * 6)
    assert "not complete" in repr(run)
    assert np.isnan(run.state.q[-1, :3]).all()
    assert np.isfinite(run.state.q[-1, 3:]).all()


def test_output_times_are_saved_with_the_number_of_steps_that_was_asked_for(tmp_path):
    run = li.run(STEP, ONE, 0.05, 100, save_at=[0.3, 1.0], **QUIET)
    stored = run.save(tmp_path / "a.zarr")
    assert "100 steps of 0.05; 3 saves, at given times" in repr(run)
    assert repr(stored).startswith(repr(run).splitlines()[0])
    assert "100 steps of 0.05; 3 saves, at given times" in repr(stored)
    same(stored.trajectory, run.trajectory)


def test_times_since_the_start_are_told_where_states_have_none():
    options = {"reduce": "energy", "per": "member", "first": lambda step, z: z.q[0] < 0.9}
    back = li.run(STEP, bodies(3), -0.05, 40, **options, **QUIET)
    every = li.run(STEP, bodies(3), -0.05, 40, **QUIET)
    below = np.asarray(every.state.q[..., 0] < 0.9)
    expected = np.where(below.any(axis=0), every.t[below.argmax(axis=0)], np.nan)
    np.testing.assert_allclose(back.summary.first, expected, rtol=1e-15)
    grid = li.run(
        STEP, bodies(3), times=every.t, reduce="energy", per="member", first=lambda step, z: z.q[0] < 0.9, **QUIET
    )
    np.testing.assert_allclose(grid.summary.first, expected, rtol=1e-15)


def test_a_run_is_extended_by_whole_intervals_between_its_saves():
    """The message was of all steps, which the call does not name: use 30 or 40."""
    run = li.run(STEP, ONE, 0.05, 20, save_every=10, **QUIET)
    with pytest.raises(ValueError, match="one save per 10 steps: extend it by 10 or 20 steps, got 15"):
        run.extend(15)


def test_a_run_shows_itself_on_one_screen():
    run = li.run(STEP, bodies(3), 0.05, 40, save_every=4, **QUIET)
    text = repr(run)
    assert text.splitlines()[0] == "step       so3_midpoint[symplectic] of RigidBody"
    assert "0 … 2, 40 steps of 0.05; 11 saves, one per 4 steps" in text
    assert len(text.splitlines()) < 12
    assert run._repr_html_().count("<tr>") == len(text.splitlines())
    jax.jit(lambda r: repr(r) and r.state.q)(run)  # inside of jit, too


@pytest.mark.long
@pytest.mark.parametrize(("name", "step", "state", "dt"), [pytest.param(*x, id=x[0]) for x in steps()])
def test_one_body_and_a_batch_are_told_apart_for_every_system(name, step, state, dt):
    run = li.run(step, state, dt, 0, **QUIET)
    assert run.members is None
    assert li.run(step, jax.tree.map(lambda x: jnp.stack([x, x]), state), dt, 0, **QUIET).members == 2
