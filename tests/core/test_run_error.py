"""How wrong a run is: the estimate by finer runs against the closed form, and where it cannot be trusted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
QUIET = {"progress": False}


def states(rates, system=BODY):
    return jax.vmap(lambda w: system.state(angular_velocity=w))(np.asarray(rates))


def rates(members, seed=0, size=1.0):
    return size * np.random.default_rng(seed).normal(size=(members, 3))


@pytest.mark.parametrize("own", ["one body", "a batch", "a body for each member"])
def test_the_error_of_a_free_body_is_that_from_its_closed_form(own, tmp_path):
    """To 0.1 %: observed 0.04 %, the next power of the step."""
    if own == "one body":
        start = BODY.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
        run = li.run(li.schemes.so3_midpoint(BODY), start, 0.05, 400, save_every=40, **QUIET)
        exact = jax.vmap(lambda t: BODY.solution(start, t))(run.t).q
    elif own == "a batch":
        starts = states(rates(5, size=0.4))
        store = tmp_path / "run.zarr"
        run = li.run(li.schemes.so3_midpoint(BODY), starts, 0.05, 400, save_every=40, store=store, **QUIET)
        exact = jax.vmap(lambda t: jax.vmap(lambda z: BODY.solution(z, t))(starts))(run.t).q[:, [0, 2, 4]]
    else:

        def member(J, w):
            body = li.systems.rigid_body(J)
            return li.schemes.so3_midpoint(body), body.state(angular_velocity=w)

        steps, starts = jax.vmap(member)(
            np.array([[1.0, 2.0, 3.0], [1.0, 1.5, 2.0], [2.0, 2.5, 3.0]]), rates(3, size=0.4)
        )
        run = li.run(steps, starts, 0.05, 400, save_every=40, own_step=True, **QUIET)
        exact = jax.vmap(lambda t: jax.vmap(lambda s, z: s.system.solution(z, t))(steps, starts))(run.t).q
    error = run.error(members=3)
    q = np.asarray(run.state.q) if own != "a batch" else np.asarray(run.state.q)[:, [0, 2, 4]]
    R = np.moveaxis(np.stack([(q * exact).sum(axis=-1)]), 0, -1)[..., 0]
    angle = 2 * np.arccos(np.minimum(abs(R), 1.0))
    assert (
        error.members is None
        if own == "one body"
        else list(error.members) == ([0, 2, 4] if own == "a batch" else [0, 1, 2])
    )
    assert error.attitude.shape == angle.shape
    np.testing.assert_allclose(error.attitude[1:], angle[1:], rtol=1e-3, atol=1e-7)  # arccos errs by √ε
    assert error.attitude.max() > 1e-3
    assert error.reliable.all()
    assert "attitude" in repr(error)


def test_bodies_have_errors_of_positions_and_attitudes_near_those_from_a_run_of_high_order():
    V = li.potentials.point_masses(1.0, [2.0, 1.0])
    pair = li.systems.rigid_bodies([2.0, 1.0], [[0.5, 0.6, 0.7], [0.1, 0.2, 0.2]], V)
    start = pair.state(
        [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], velocities=[[0.0, -0.3, 0.0], [0.0, 0.6, 0.0]],
        angular_velocities=[[0.0, 0.1, 1.0], [0.5, 0.0, 0.3]],
    )  # fmt: skip
    run = li.run(li.schemes.splitting(pair), start, 0.1, 60, save_every=20, **QUIET)
    exact = li.run(li.schemes.extrapolate(pair, 12), start, 0.1, 60, save_every=20, **QUIET)
    error = run.error()
    distance = np.linalg.norm((run.state.q - exact.state.q)[..., :3], axis=-1)
    np.testing.assert_allclose(error.position[1:], distance[1:], rtol=0.01, atol=0)
    assert error.attitude.shape == (4, 2)
    assert error.reliable.all()


@pytest.mark.long
def test_where_a_top_is_chaotic_the_error_is_marked_as_unreliable():
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [1.0, 0.3, 0.2])
    run = li.run(li.schemes.splitting(top), states(rates(4, size=1.5), top), 0.05, 4000, save_every=40, **QUIET)
    error = run.error()
    assert error.reliable[:5].all()
    assert not error.reliable[-1].all()
    assert "reliable until t = " in repr(error)
    assert "chaotic, a torque jumps, or the step is too large" in repr(error)


def test_an_error_at_round_off_is_no_sign_of_chaos():
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [1.0, 0.3, 0.2])
    run = li.run(li.schemes.extrapolate(top, 12), states(rates(2), top), 0.05, 20, save_every=10, **QUIET)
    error = run.error()
    assert error.reliable.all()
    assert error.attitude.max() < 1e-12  # observed: 4e-15


def test_a_run_at_given_times_has_no_step_to_halve():
    start = BODY.state(angular_velocity=[0.2, 0.0, 1.0])
    run = li.run(li.schemes.so3_midpoint(BODY), start, times=[0.0, 0.1, 0.3], **QUIET)
    with pytest.raises(ValueError, match="half the step size, and this run has given times"):
        run.error()


def test_the_first_line_of_a_certificate_is_the_error_from_the_closed_form():
    """To 0.1 %, and of a run whose energy, momentum and form are conserved to round-off."""
    start = BODY.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    step = li.schemes.so3_midpoint(BODY, li.maps.kappa_symplectic)
    certificate = li.diagnostics.certify(step, start, 0.05, 1000)
    run = li.run(step, start, 0.05, 1000, save_every=10, **QUIET)
    exact = jax.vmap(lambda t: BODY.solution(start, t))(run.t).q
    angle = jax.vmap(li.groups.so3.angle)(run.state.q, exact)
    np.testing.assert_allclose(certificate.error.attitude[::10], angle, rtol=1e-3, atol=1e-12)
    first, second, *_ = str(certificate).splitlines()
    assert first == "attitude up to 0.022 rad (1.2°) off until t = 50, by a run with dt/2"
    assert second.startswith("so3_midpoint[symplectic] · RigidBody")
    assert certificate.energy < 1e-14


def test_a_certificate_of_a_step_that_loses_count_of_turns_states_it():
    """At dt = 0.5 the attitude is off by more than π at t = 500, so that the angle that is left is no measure."""
    start = BODY.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    error = li.diagnostics.certify(li.schemes.so3_midpoint(BODY), start, 0.5, 1000).error
    assert error.attitude.max() <= np.pi
    assert not error.reliable[-1]
    assert " off or more: from t = " in error.summary
    assert (
        "a smaller dt does not reduce it as order 2 says (chaos, dt too large, or a torque that jumps)" in error.summary
    )


@pytest.mark.long
def test_an_error_that_returns_to_zero_at_every_swing_is_no_sign_of_chaos():
    """That of a plane pendulum, at other moments in each of the three runs; next to a run of high order."""
    bob = li.systems.pendulum(1.0, 9.81)
    start = bob.state([0.6, 0.0, -0.8], velocity=[0.0, 0.0, 0.0])
    error = li.diagnostics.certify(li.schemes.sphere_midpoint(bob), start, 0.02, 400).error
    assert error.reliable.all()
    fine = li.run(li.schemes.compose(li.schemes.sphere_midpoint(bob), 6), start, 0.01, 800, save_every=2, **QUIET)
    coarse = li.run(li.schemes.sphere_midpoint(bob), start, 0.02, 400, save_every=1, **QUIET)
    distance = np.linalg.norm(coarse.state.q - fine.state.q, axis=-1)
    assert np.sum(np.diff(np.sign(np.diff(distance))) > 0) > 5  # minima
    np.testing.assert_allclose(error.q, distance, rtol=0, atol=0.01 * distance.max())
    assert error.summary.startswith(f"q up to {distance.max():.2g} off until t = 8")


@pytest.mark.long
def test_where_steps_vary_runs_are_compared_at_equal_times():
    top = li.systems.potential_top([1.0, 2.0, 2.5], lambda Gamma: Gamma @ jnp.array([1.0, 0.3, 0.2]) - 2)  # V < 0
    start = top.state(angular_velocity=[0.1, 0.2, 0.5])._replace(t=jnp.asarray(0.0))
    step = li.schemes.log_hamiltonian(top)
    certificate = li.diagnostics.certify(step, step.start(start), 0.05, 60)
    run = li.integrate(step, step.start(start), 0.05, 60, save_every=60)
    exact = li.diagnostics.flow(top, start, run.t[-1], 60)
    angle = float(li.groups.so3.angle(run.state.q[-1], exact.q))
    assert certificate.error.attitude[-1] == pytest.approx(angle, rel=0.01)
    assert certificate.error.t[-1] == run.t[-1] < 0.05 * 60
