"""Forces given on several bodies: their work of either sign is booked, and their impulses are those of the momenta."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slopes
from equations import quaternion_rate
from repeated import last
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import potentials, schemes, systems

MASSES, MOMENTS = np.array([1.0, 0.4]), np.array([[0.08, 0.10, 0.13], [0.02, 0.03, 0.035]])
GRAVITY = potentials.point_masses(1.0, MASSES)
REST = {"push": np.zeros((2, 3)), "twist": np.zeros((2, 3)), "wave": np.zeros((2, 3)), "drag": np.zeros(())}


def law(given, t, x, R, v, omega):
    """Forces and torques fixed in the bodies, forces in space that come and go, and a drag of either sign."""
    turned = jnp.einsum("nij,knj->kni", R, jnp.stack([given["push"], given["twist"]]))
    return turned[0] + jnp.cos(t) * given["wave"] - given["drag"] * v, turned[1]


def bodies(moments=MOMENTS, masses=MASSES, gravity=GRAVITY, **given):
    forces = jax.tree_util.Partial(law, {k: jnp.asarray(x, float) for k, x in (REST | given).items()})
    return systems.rigid_bodies(masses, moments, gravity, forces=forces)


def start(system, **more):
    shares = np.array([[-MASSES[1]], [MASSES[0]]]) / MASSES.sum()
    x, v = shares * np.array([2.0, 0.0, 0.0]), shares * np.array([0.0, 0.8, 0.1])
    return system.state(x, velocities=v, angular_velocities=[[0.2, 0.1, 0.6], [0.3, -0.4, 0.5]], **more)


def run(system, state, dt, num_steps, order=2):
    step = schemes.bodies_energy_momentum(system)
    return li.integrate(step if order == 2 else schemes.compose(step, order), state, dt, num_steps)


PUSHES = {
    "push": [[0.006, 0.0, -0.003], [0.0, 0.003, 0.0]],
    "twist": [[0.0003, 0.0, 0.001], [0.0, 0.0002, 0.0]],
    "wave": [[0.0, 0.02, 0.0], [0.0, 0.0, -0.01]],
    "drag": 3e-4,
}


@functools.cache
def pushed():
    system = bodies(**PUSHES)
    return system, run(system, start(system), 0.02, 10_000)


def test_energy_less_work_is_constant_while_both_rise_and_fall():
    """Over 10⁴ steps, in which the energy passes from −0.08 to 0.26. Observed 7e-15."""
    system, path = pushed()
    assert path.info.converged.all()
    gained = np.diff(path.state.work)
    assert gained.min() < -1e-5
    assert gained.max() > 1e-5
    H = np.asarray(jax.vmap(system.energy)(path.state))
    error = np.abs(H - path.state.work - H[0])
    assert error.max() < 3e-14


def test_both_momenta_change_by_the_impulses():
    """Over each step by Δt times the forces in its middle, and their moments at ½(x_n + x_{n+1}). Observed 4e-14."""
    system, path = pushed()
    assert system.momentum(start(system)).shape == (0,)
    momenta = np.asarray(jax.vmap(system.conservative.momentum)(path.state))
    x, q = (np.asarray(y) for y in (path.state.q[..., :3], path.state.q[..., 3:]))
    middle = q[1:] + q[:-1]
    R = np.stack([Rotation.from_quat(np.roll(middle[:, i], -1, 1)).as_matrix() for i in (0, 1)], axis=1)
    t, v = np.asarray(path.state.t[1:]) - 0.01, np.diff(x, axis=0) / 0.02
    push, twist = (np.einsum("tnij,nj->tni", R, np.array(PUSHES[k])) for k in ("push", "twist"))
    force = push + np.cos(t)[:, None, None] * np.array(PUSHES["wave"]) - PUSHES["drag"] * v
    moments = np.cross((x[1:] + x[:-1]) / 2, force) + twist
    impulses = 0.02 * np.cumsum(np.concatenate([force, moments], axis=2).sum(1), axis=0)
    np.testing.assert_allclose(momenta[1:] - momenta[0], impulses, rtol=0, atol=2e-13)


def dop853(system, state, span, given):
    """The same bodies in numpy: (x, v) in space, attitude of scipy, Ω in the body."""

    def rate(t, y):
        x, v, q, w = (y[k : k + m].reshape(2, -1) for k, m in ((0, 6), (6, 6), (12, 8), (20, 6)))
        r = x[1] - x[0]
        pull = MASSES[0] * MASSES[1] * r / np.linalg.norm(r) ** 3
        turn = [Rotation.from_quat(np.roll(a, -1)) for a in q]
        given_force = [turn[i].apply(given["push"][i]) + np.cos(t) * np.array(given["wave"][i]) for i in (0, 1)]
        force = np.array([pull, -pull]) + given_force - given["drag"] * v
        w_dot = (np.array(given["twist"]) - np.cross(w, MOMENTS * w)) / MOMENTS
        q_dot = [quaternion_rate(a, b) for a, b in zip(q, w, strict=True)]
        return np.concatenate([v.ravel(), (force / MASSES[:, None]).ravel(), np.ravel(q_dot), w_dot.ravel()])

    w = system.angular_velocities(state)
    v = state.p[:, :3] / MASSES[:, None]
    y = np.concatenate([np.ravel(z) for z in (state.q[:, :3], v, state.q[:, 3:], w)])
    end = solve_ivp(rate, (0, span), y, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.concatenate([end[:6].reshape(2, 3), end[12:20].reshape(2, 4)], axis=1)


@pytest.mark.long
@pytest.mark.parametrize("order", [2, 4])
def test_the_motion_is_that_of_an_explicit_method_on_equations_of_its_own(order):
    """Observed orders 2.00 and 4.00."""
    system = bodies(**PUSHES)
    expected, errors = dop853(system, start(system), 4.0, PUSHES), []
    for n in (40, 80):
        end = run(system, start(system), 4.0 / n, n, order).state.q[-1]
        errors.append(np.abs(end - expected).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.02)


@pytest.mark.long
def test_a_constant_torque_spins_a_body_up_as_in_closed_form():
    """YORP: ω = ω₀ + Tt/J about a principal axis, and its work is the energy of the spin, both ways. 2e-14."""
    torque, spin, t = np.array([0.0, 0.0, 0.002]), 0.5, 20.0
    for sign in (1, -1):
        system = bodies(twist=[[0, 0, 0], sign * torque])
        state = start(system)._replace(t=jnp.zeros(()))
        Omega = np.array([[0.0, 0.0, 0.2], [0.0, 0.0, spin]])
        state = system.state(state.q[:, :3], velocities=state.p[:, :3] / MASSES[:, None], angular_velocities=Omega)
        end = last(run(system, state, 0.02, 1000))
        found, expected = system.angular_velocities(end)[1, 2], spin + sign * torque[2] * t / MOMENTS[1, 2]
        assert float(found) == pytest.approx(expected, rel=1e-12, abs=0)
        assert float(end.work) == pytest.approx(MOMENTS[1, 2] * (expected**2 - spin**2) / 2, rel=1e-11, abs=0)


@pytest.mark.long
def test_byorp_moves_a_binary_outward_by_the_secular_formula():
    """A force along the track, fixed in a synchronous secondary: da/dt = 2a_t/n, so that a^(−½) falls by a_t t/√(GM).

    The distance changes by 5 % in 200 orbits, as the formula says to 0.2 % of that. H − W is constant to 2e-14.
    """
    m, along, steps, orbits = np.array([1.0, 1e-3]), 2e-5, 100, 200
    J = np.array([[0.4e-2] * 3, [0.8e-7, 1.0e-7, 1.1e-7]])
    gravity = potentials.maccullagh(1.0, m, J)
    shares = np.array([[-m[1]], [m[0]]]) / m.sum()
    rate = np.sqrt(m.sum())
    for sign in (1, -1):
        push = m[1] * sign * along * np.array([[0, 0, 0], [0, 1.0, 0]])
        system = bodies(J, m, gravity, push=push)
        state = system.state(
            shares * np.array([1.0, 0, 0]),
            velocities=shares * np.array([0, rate, 0]),
            angular_velocities=[[0, 0, 0], [0, 0, rate]],
        )
        end = run(system, state, 2 * np.pi / rate / steps, steps * orbits)
        assert end.info.converged.all()
        tail = end.state.q[-3 * steps :]
        r = tail[:, 1, :3] - tail[:, 0, :3]
        a = float(jnp.mean(jnp.linalg.norm(r, axis=1)))
        t = float(jnp.mean(end.state.t[-3 * steps :]))
        expected = (1 - sign * along * t / rate) ** -2
        assert (a - 1) / (expected - 1) == pytest.approx(1, abs=0.004)
        H = jax.vmap(system.energy)(end.state) - end.state.work
        assert jnp.abs(H / H[0] - 1).max() < 1e-13


@pytest.mark.long
def test_the_work_has_derivatives_by_the_numbers_of_the_forces():
    system = bodies(**PUSHES)
    slopes.assert_agree(schemes.bodies_energy_momentum(system), start(system), 0.02)


@pytest.mark.long
def test_a_force_that_is_not_finite_or_too_stiff_is_flagged():
    take = jax.jit(lambda system, z: schemes.bodies_energy_momentum(system)(z, 0.05)[1].converged)
    state = start(bodies())
    assert [bool(take(bodies(drag=drag), state)) for drag in (0.1, 1e4, np.nan)] == [True, False, False]
    assert not take(bodies(), state._replace(q=state.q.at[0, 0].set(jnp.nan)))
