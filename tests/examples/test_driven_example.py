"""The example driven, a satellite under the gravity gradient: its start, its angles, its work, Jacobi's integral."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import satellite
from example_runs import run_example
from kept_values import numbers_after
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax.examples import driven

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def orbit(tmp_path_factory):
    """The report and the run of an orbit, by 50 members, of which some tumble: their spins are five times as wide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driven, "SPREAD", driven.SPREAD * [1, 5])
        return run_example(driven, tmp_path_factory.mktemp("driven"), members=50, steps=400)


def test_the_first_member_starts_at_rest_relative_to_the_orbit_and_others_near_it(orbit):
    _, run = orbit
    body, states = run.system, jax.tree.map(lambda x: x[0], run.state)
    R, spin = li.measure.orbit_axes(body.orbit, 0.0)
    first = jax.tree.map(lambda x: jnp.asarray(x[0]), states)
    np.testing.assert_allclose(body.rotation_matrix(first) @ body.angular_velocity(first), spin, rtol=0, atol=1e-17)
    boom = R.T @ body.rotation_matrix(first)[:, 0]
    np.testing.assert_allclose(boom, [np.cos(np.deg2rad(3)), 0, -np.sin(np.deg2rad(3))], rtol=0, atol=1e-15)
    rates = np.asarray(jax.vmap(body.angular_velocity)(jax.tree.map(jnp.asarray, states)))
    assert np.std(rates[1:] - rates[0]) == pytest.approx(np.deg2rad(0.1), rel=0.3)
    turns = Rotation.from_quat(np.asarray(states.q)[:, [1, 2, 3, 0]])
    assert np.std((turns[1:] * turns[0].inv()).as_rotvec()) == pytest.approx(np.deg2rad(10.0), rel=0.3)


def test_an_orbit_agrees_with_another_integrator(orbit):
    """400 steps of second order. DOP853 moves the center along, without Kepler; lengths and times are those of a."""
    text, run = orbit
    body, one = run.system, run.member(0)
    state = jax.tree.map(lambda x: jnp.asarray(x[0]), one.state)
    n = float(body.orbit.mean_motion)
    r, v = body.orbit(0.0)
    a = driven.SEMI_MAJOR_AXIS
    start = [body.rotation_matrix(state).ravel(), body.angular_velocity(state) / n, r / a, v / (a * n)]
    options = dict(rtol=1e-11, atol=1e-11, args=(np.asarray(body.inertia), 1.0))
    end = solve_ivp(satellite, [0, n * one.t[-1]], np.concatenate(start), "DOP853", **options).y[:9, -1]
    q = np.asarray(one.state.q[-1])
    apart = Rotation.from_quat(q[[1, 2, 3, 0]]).inv() * Rotation.from_matrix(end.reshape(3, 3))
    assert apart.magnitude() < 2.5e-3
    assert float(numbers_after("energy less work, relative", text)[0]) < 1e-13
    assert 0.3 < float(numbers_after("energy, on which the orbit works", text)[0]) < 2


def test_the_report_has_the_angles_of_the_boom_from_the_vertical_and_counts_those_that_librate(orbit):
    text, run = orbit
    boom = Rotation.from_quat(np.asarray(run.state.q).reshape(-1, 4)[:, [1, 2, 3, 0]]).apply([1.0, 0.0, 0.0])
    up = np.stack([np.asarray(run.system.orbit(t)[0]) for t in run.t])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    cosine = np.einsum("tmi,ti->tm", boom.reshape(*run.state.q.shape[:2], 3), up)
    angle = np.rad2deg(np.arccos(abs(cosine)))
    for word, value in {"mean": angle[:, 0].mean(), "largest": angle[:, 0].max()}.items():
        found = numbers_after(f"least inertia's axis from the vertical, {word} (°)", text)[0]
        assert float(found) == pytest.approx(value, abs=6e-4)
    librating = (abs(np.sign(cosine).sum(axis=0)) == len(cosine)).sum()
    assert f"{librating} of 50 members librate" in text
    assert 10 < librating < 50


def test_jacobi_s_integral_is_conserved_on_a_circle(tmp_path):
    """H − n·π, n the normal of the orbit times its mean motion, to the second order of the scheme."""
    changes = []
    for k in (1, 2):
        folder = tmp_path / f"{k}"
        folder.mkdir()
        given = {"steps": 400 * k, "steps_per_orbit": 400 * k, "eccentricity": 0.0}
        _, run = run_example(driven, folder, members=2, **given)
        normal = li.measure.orbit_axes(run.system.orbit, 0.0)[1]
        energy, p = np.asarray(run.map(lambda step, z: step.system.energy(z))), np.asarray(run.state.p)
        changes.append(np.ptp(energy - p @ normal, axis=0) / np.ptp(energy, axis=0))
    coarse, fine = changes
    assert coarse.max() < 1e-2
    np.testing.assert_allclose(coarse / fine, 4, rtol=0.1)
