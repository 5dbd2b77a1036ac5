"""The mean periods of a tumbling free body: against scipy's integrals, the motion itself, limits, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.special import ellipk

import lieint_jax as li
from lieint_jax import systems
from lieint_jax.groups import so3

APOPHIS = [0.61, 0.965, 1.0]


@jax.jit
def periods(J, Pi):
    """Of a body whose axes are those of space."""
    return systems.RigidBody(J).periods(li.State(jnp.array([1.0, 0, 0, 0]), Pi))


def by_quadrature(J, Pi):
    """P_φ and P_ψ from Landau & Lifshitz § 37, with φ̇ averaged over half a period; A < B < C."""
    (A, B, C), L2, H2 = J, float(Pi @ Pi), float(Pi @ (Pi / J))
    f, g = (B - A) * (H2 * C - L2), (C - B) * (L2 - H2 * A)
    m = min(f, g) / max(f, g)
    rotation = 4 * ellipk(m) * np.sqrt(A * B * C / max(f, g))
    top = A * (H2 * C - L2) / (C - A)

    def rate(a):
        """φ̇ over dτ/da, τ = F(a, m)."""
        sine = np.sin(a) ** 2
        x2 = top * (1 - m * sine if f > g else 1 - sine)
        return (H2 - x2 / A) / (L2 - x2) / np.sqrt(1 - m * sine)

    mean = quad(rate, 0, np.pi / 2, epsabs=0, epsrel=1e-13)[0] / ellipk(m)
    return 2 * np.pi / (np.sqrt(L2) * mean), rotation, f > g


@pytest.mark.parametrize("long_axis", [False, True])
def test_periods_of_both_modes_agree_with_quadrature(long_axis):
    """Observed 7e-15."""
    random = np.random.default_rng(3)
    found = 0
    while found < 20:
        J = np.sort(random.uniform(0.4, 1.0, 3))
        Pi = random.normal(size=3)
        expected = by_quadrature(J, Pi)
        if expected[2] != long_axis:
            continue
        found += 1
        ours = periods(jnp.asarray(J), jnp.asarray(Pi))
        np.testing.assert_allclose(ours[:2], expected[:2], rtol=5e-14)
        assert bool(ours.long_axis) == long_axis


@pytest.mark.parametrize("Pi", [[0.15, 0.0, 0.2], [0.3, 0.05, 0.1]])
def test_the_motion_has_these_periods(Pi):
    """A short- and a long-axis mode, by DOP853 over 5 turns of Π: the long axis' longitude about π, Π after a turn."""
    J, Pi = np.array(APOPHIS), np.array(Pi)
    expected = periods(jnp.asarray(J), jnp.asarray(Pi))

    def rate(_, state):
        M, (x, y, z) = state[9:], state[9:] / J
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # a row times this is row × Ω
        return np.concatenate([(state[:9].reshape(3, 3) @ across).ravel(), M @ across])

    end = 5 * float(expected.rotation)
    t = np.linspace(0, end, 1001)
    y = solve_ivp(rate, (0, end), np.concatenate([np.eye(3).ravel(), Pi]), "DOP853", t, rtol=1e-12, atol=1e-13).y
    np.testing.assert_allclose(y[9:, -1], Pi, rtol=0, atol=1e-9)
    up = Pi / np.linalg.norm(Pi)
    e1 = np.cross(up, [0.0, 1.0, 0.0])
    e1 /= np.linalg.norm(e1)
    long = y[[0, 3, 6]]
    longitude = np.unwrap(np.arctan2(np.cross(up, e1) @ long, e1 @ long))
    assert 2 * np.pi * end / (longitude[-1] - longitude[0]) == pytest.approx(float(expected.precession), rel=1e-9)


@pytest.mark.long
def test_order_of_the_axes_a_full_tensor_and_units_do_not_matter():
    Pi = np.array([0.2, 0.3, 0.6])
    plain = periods(jnp.asarray(APOPHIS), jnp.asarray(Pi))
    turn = np.asarray(so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4]))))
    for J, M in (
        (np.roll(APOPHIS, 1), np.roll(Pi, 1)),
        (np.asarray(APOPHIS)[[1, 0, 2]], Pi[[1, 0, 2]]),
        (turn @ np.diag(APOPHIS) @ turn.T, turn @ Pi),
    ):
        np.testing.assert_allclose(periods(jnp.asarray(J), jnp.asarray(M)), plain, rtol=2e-14)
    scaled = periods(7 * jnp.asarray(APOPHIS), 3 * jnp.asarray(Pi))
    np.testing.assert_allclose(scaled[:2], np.array(plain[:2]) * 7 / 3, rtol=1e-14)


def test_periods_have_the_known_limits():
    """Spin about an axis: the period of small wobbles; symmetric bodies, a sphere, rest, and the separatrix."""
    A, B, C = APOPHIS
    for axis, J, size in ((2, C, (C - A) * (C - B) / (A * B)), (0, A, (B - A) * (C - A) / (B * C))):
        found = periods(jnp.asarray(APOPHIS), jnp.asarray(np.eye(3)[axis]))
        assert float(found.rotation) == pytest.approx(2 * np.pi * J / np.sqrt(size), rel=1e-14, abs=0)
    about_short = periods(jnp.asarray(APOPHIS), jnp.asarray([0.0, 0.0, 0.5]))
    assert float(about_short.precession) == pytest.approx(4 * np.pi, rel=1e-15, abs=0)
    prolate = periods(jnp.asarray([0.5, 1.0, 1.0]), jnp.asarray([0.3, 0.4, 0.0]))
    assert float(prolate.precession) == pytest.approx(4 * np.pi, rel=1e-14, abs=0)
    assert float(prolate.rotation) == pytest.approx(2 * np.pi / 0.3, rel=1e-14, abs=0)
    assert bool(prolate.long_axis)
    oblate = periods(jnp.asarray([1.0, 1.0, 2.0]), jnp.asarray([0.3, 0.0, 0.4]))
    assert float(oblate.rotation) == pytest.approx(2 * np.pi / 0.2, rel=1e-14, abs=0)
    assert np.isinf(periods(jnp.ones(3), jnp.asarray([0.1, 0.2, 0.3])).rotation)
    ball = periods(jnp.ones(3), jnp.asarray([0.0, 0.6, 0.8]))
    assert float(ball.precession) == pytest.approx(2 * np.pi, rel=1e-15, abs=0)
    assert np.isinf(periods(jnp.asarray(APOPHIS), jnp.zeros(3))[:2]).all()
    assert periods(jnp.asarray(APOPHIS), jnp.asarray([0.0, 1.0, 0.0])).rotation > 400  # 33 is that of small wobbles


def test_precession_next_to_the_separatrix_and_of_a_disc_on_edge():
    """There the long axis stays across π and goes round at |π|/B; a disc on edge spins at |π|/A."""
    middle = periods(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.0, 1.0, 0.0]))
    assert float(middle.precession) == pytest.approx(4 * np.pi, rel=1e-2)  # 1.7e-3: of a motion 1e-154 off
    for z in (0.0, 1e-9, 1e-7, 1e-5):
        found = periods(jnp.asarray([1.0, 1.0, 2.0]), jnp.asarray([0.3, 0.4, z]))
        spin = np.hypot(0.5, z) - z / 2  # of the body: precession of the short axis, less the turn about it
        assert float(found.precession) == pytest.approx(2 * np.pi / spin, rel=1e-10, abs=0)


@pytest.mark.long
def test_derivatives_of_periods_by_inertia_and_state_agree_with_differences():
    """Forward and reverse against central differences of a step of 1e-5: observed 4e-9."""

    def both(x):
        body = systems.rigid_body(x[:3])
        found = body.periods(body.state(so3.exp(x[3:6]), spatial_momentum=x[6:]))
        return jnp.stack(found[:2])

    value = jax.jit(both)
    for Pi in ([0.2, 0.1, 0.8], [0.8, 0.1, 0.2]):
        x = jnp.asarray([*APOPHIS, 0.2, -0.1, 0.3, *Pi])
        forward, reverse = (np.asarray(jax.jit(d(both))(x)) for d in (jax.jacfwd, jax.jacrev))
        np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11)
        h = 1e-5 * np.eye(9)
        slopes = np.stack([(value(x + e) - value(x - e)) / 2e-5 for e in h], axis=1)
        np.testing.assert_allclose(forward, slopes, rtol=0, atol=3e-8 * abs(slopes).max())


@pytest.mark.long
@pytest.mark.parametrize("long_axis", [False, True])
def test_a_state_of_given_periods_has_them(long_axis):
    """Principal moments in any order and a tensor, from a wobble to near the separatrix; there 1.2e-11."""
    turn = np.asarray(so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4]))))
    moments = np.roll(APOPHIS, 1)
    for J in (moments, turn @ np.diag(moments) @ turn.T):
        body = systems.rigid_body(J)
        for ratio in (2.5, 9.59, 30.0) if long_axis else (8.0, 9.59, 30.0):
            state = body.state_from_periods(precession=27.38, rotation=27.38 * ratio, long_axis=long_axis)
            found = body.periods(state)
            np.testing.assert_allclose(found[:2], [27.38, 27.38 * ratio], rtol=5e-11)
            assert bool(found.long_axis) == long_axis


@pytest.mark.long
def test_the_derivative_of_a_state_by_its_periods_is_inverse_to_theirs():
    """∂(periods)/∂(state) ∂(state)/∂(periods) = 1, and nothing for the inertia, whose periods are held."""
    given = jnp.asarray([*APOPHIS, 27.38, 263.0])

    def again(x):
        body = systems.rigid_body(x[:3])
        return jnp.stack(body.periods(body.state_from_periods(precession=x[3], rotation=x[4], long_axis=False))[:2])

    slopes = jax.jit(jax.jacfwd(again))(given)
    np.testing.assert_allclose(slopes[:, 3:], np.eye(2), rtol=0, atol=1e-9)
    np.testing.assert_allclose(slopes[:, :3], 0, rtol=0, atol=1e-6)


@pytest.mark.long
def test_the_periods_of_a_run_are_those_of_each_state():
    """Constant in free motion; of a body with torques they are those of the moment."""
    body = systems.rigid_body(APOPHIS)
    state = body.state_from_periods(precession=27.38, rotation=263.0, long_axis=False)
    run = li.integrate(li.schemes.exact(body), state, 1.0, 20)
    found = run.periods(body)
    np.testing.assert_allclose(found.rotation, np.full(21, 263.0), rtol=1e-11)
    np.testing.assert_allclose(found.precession, np.full(21, 27.38), rtol=1e-12)
    assert not found.long_axis.any()
    with pytest.raises(ValueError, match="must have periods"):
        run.periods(li.systems.pendulum(1.0, 1.0))


@pytest.mark.long
@pytest.mark.parametrize("long_axis", [False, True])
def test_a_tumbling_state_has_its_periods_and_phases_in_both_modes(long_axis):
    """φ is the angle of the long axis from the given direction about π; ψ grows by 2π in P_ψ; the motion is free."""
    J, toward, pole = jnp.array([0.55, 0.8, 1.0]), jnp.array([0.3, -0.9, 0.2]), jnp.array([0.48, -0.6, 0.64])
    options = {"long_axis": long_axis, "toward": toward, "phi": 2.0}
    at = jax.jit(lambda psi: systems.tumbling_state(J, 20.0, 60.0, pole, psi=psi, **options))
    near, body = at(4.5), systems.RigidBody(J)
    found = body.periods(near)
    np.testing.assert_allclose([found.precession, found.rotation], [20.0, 60.0], rtol=1e-12)
    assert bool(found.long_axis) == long_axis
    np.testing.assert_allclose(near.p / np.linalg.norm(near.p), pole, rtol=0, atol=1e-15)
    e1, e2 = (v - v @ pole * pole for v in (np.asarray(toward), np.asarray(so3.to_matrix(near.q))[:, 0]))
    angle = np.arctan2(np.cross(e1, e2) @ pole, e1 @ e2)
    assert angle % (2 * np.pi) == pytest.approx(2.0, abs=1e-12)
    later, there = body.solution(near, 60.0 * 1.1 / (2 * np.pi)), at(4.5 + 1.1)
    np.testing.assert_allclose(body.body_momentum(later), body.body_momentum(there), rtol=0, atol=1e-13)
    x, y, _ = body.body_momentum(at(0.0))
    assert x > 0
    assert abs(y) < 1e-15


def test_a_state_of_periods_that_no_mode_has_is_nan():
    """The least ratio is that of small wobbles; next to the separatrix rounding leaves no digits of an immense one."""
    J, pole = jnp.array(APOPHIS), jnp.array([0.0, 0.0, 1.0])
    wobble = 1 / np.sqrt((1 - 0.61) * (1 - 0.965) / (0.61 * 0.965))
    at = jax.jit(
        lambda ratio: systems.RigidBody(J).periods(systems.tumbling_state(J, 1.0, ratio, pole, long_axis=False))
    )
    for ratio, exists in ((0.999 * wobble, False), (1.001 * wobble, True), (50.0, True), (150.0, False)):
        found = np.asarray(at(ratio)[:2])
        assert np.isfinite(found).all() == exists
        if exists:
            np.testing.assert_allclose(found, [1.0, ratio], rtol=1e-7)  # observed: 5e-9 of 50
