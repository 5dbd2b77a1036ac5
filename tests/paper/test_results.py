"""Results 1 to 5 of the paper as theorems, each with its refutation. Bounds are a few times the floors noted."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest
from paper import ONE, hat

import lieint_jax as li
from lieint_jax.diagnostics import linearization
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa, kappa_cayley, kappa_exponential, kappa_symplectic

KAPPAS = {k.name: k for k in (kappa_cayley, kappa_exponential, kappa_symplectic)}
KAPPAS["1 + x/3"] = Kappa(jax.tree_util.Partial(lambda x: 1 + x / 3), "1 + x/3")
number = st.floats(-1, 1, width=64)
vectors = st.tuples(number, number, number).map(np.array)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))
moments = st.tuples(*[st.floats(0.2, 1)] * 3).map(lambda m: np.array([m[1] + m[2], m[0] + m[2], m[0] + m[1]]))
turns = st.floats(0.01, 0.75)
signs = st.sampled_from([-1.0, 1.0])


@jax.jit
def _turned(q, Theta, Pi):
    """ΛΠ before a turn by cay Θ, after it with Π carried by Ad*, and after it with Π carried the wrong way."""
    turn, after = so3.cayley(Theta), so3.cayley_increment(q, Theta / 2)
    return so3.Ad(q, Pi), so3.Ad(after, so3.Ad_star(turn, Pi)), so3.Ad(after, so3.Ad(turn, Pi))


@hypothesis.given(directions, vectors, vectors, st.floats(-4, 4))
def test_result_01_momentum_for_any_theta(axis, Theta, Pi, angle):
    """With the steps' own pieces, Λ cay Θ and Π carried by Ad* keep ΛΠ whatever Θ is: it need not solve anything."""
    q = np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis])
    before, after, wrong = map(np.asarray, _turned(q, 4 * Theta, Pi))
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-14)  # floor 2e-15
    across = np.linalg.norm(np.cross(Theta, Pi))
    assert np.abs(wrong - before).max() > across / 5 - 1e-14


@jax.jit
def _cayley(Theta):
    return so3.to_matrix(so3.cayley(Theta))


@hypothesis.given(directions, st.floats(0.1, 2), st.floats(0, 1))
def test_result_02_on_the_group_exactly_if_alpha_is_one_half(axis, size, alpha):
    Theta = size * axis
    defect = np.abs(paper.T(alpha, Theta) @ paper.T(alpha, Theta).T - ONE).max()
    nu = (2 * alpha - 1) / (1 + alpha**2 * size**2)
    assert defect == pytest.approx(np.abs(nu * hat(Theta) @ hat(Theta)).max(), abs=2e-15)
    assert np.abs(paper.T(0.5, Theta) @ paper.T(0.5, Theta).T - ONE).max() < 2e-15
    np.testing.assert_allclose(paper.T(0.5, Theta), _cayley(Theta), rtol=0, atol=2e-15)  # (2.23)


@jax.jit
def _steps(J, q, Omega, dt, kappa):
    """Twenty steps from a state, for any κ: energies relative to theirs, ΛΠ over |π|, |q|² − 1."""
    body = li.systems.RigidBody(J)
    state = body.state(q, angular_velocity=Omega)
    step = li.schemes.so3_midpoint(body, kappa)
    run = li.Run.of(step, li.integrate(step, state, dt, 20))
    energy = run.energy_error() / body.energy(state)
    Q, Pi = jax.vmap(so3.to_matrix)(run.state.q), jax.vmap(body.body_momentum)(run.state)
    carried = (jnp.einsum("nij,nj->ni", Q, Pi) - state.p) / jnp.linalg.norm(state.p)
    return energy, run.momentum_error(), run.constraint_error(), run.info.converged, carried


@pytest.mark.paper("2.2: (2.25)–(2.28), Result 3", "energy for any κ", "schemes/_so3_midpoint.py")
@pytest.mark.slow
@pytest.mark.parametrize("name", KAPPAS)
@hypothesis.given(moments, st.tuples(number, number, number, st.floats(0.2, 1)), directions, turns, signs)
def test_result_03_energy_for_any_kappa(name, J, q, axis, turn, sign):
    """Random bodies, attitudes, spins and steps of both signs: energy to round-off, momentum bit for bit, |q| = 1."""
    q = np.array(q) / np.linalg.norm(q)
    energy, momentum, constraint, converged, carried = map(np.asarray, _steps(J, q, axis, sign * turn, KAPPAS[name]))
    assert np.abs(momentum).max() == 0  # Result 1: whether or not the equation is solved
    hypothesis.assume(converged.all())
    assert np.abs(energy).max() < 8e-15  # floor 2e-15
    assert np.abs(carried).max() < 4e-15  # floor 2e-15
    assert np.abs(constraint).max() < 2e-15  # floor 7e-16


@pytest.mark.slow
@pytest.mark.parametrize("name", KAPPAS)
def test_result_03_holds_at_every_converged_step_of_moderate_size(name):
    """The assumption above is not empty: for |ΔtΩ| ≤ 0.7 every step of ordinary bodies converges."""
    rng = np.random.default_rng(5)
    moments = rng.uniform(0.3, 1, (200, 3)) @ np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
    Omega = rng.normal(size=(200, 3))
    Omega /= np.linalg.norm(Omega, axis=1, keepdims=True)

    one = np.array([1.0, 0.0, 0.0, 0.0])
    for J, spin in zip(moments, Omega, strict=True):
        assert _steps(J, one, spin, 0.7, KAPPAS[name])[3][1]


def test_result_03_energy_needs_theta_parallel_to_the_mean_velocity():
    """A Θ turned by a degree from Ω_{n+½} is still momentum-conserving and loses energy."""
    J = np.diag([1.0, 2.0, 3.0])
    Pi0 = J @ [0.5, -0.3, 0.8]

    def step(turn):
        Pi1 = Pi0
        for _ in range(200):
            bar = 0.1 * np.linalg.inv(J) @ (Pi0 + Pi1) / 2
            Pi1 = paper.cay(-turn @ bar) @ Pi0
        return Pi1 @ np.linalg.inv(J) @ Pi1 / 2 - Pi0 @ np.linalg.inv(J) @ Pi0 / 2

    assert abs(step(ONE)) < 4e-16
    assert abs(step(paper.exp(np.array([0.0, np.pi / 180, 0.0])))) > 1e-4


@jax.jit
def _linearized(J, q, Omega, dt, kappa):
    """A step; Θ̄, T and H of (3.3); how far it is from symplectic by autodiff, and the size of its linearization."""
    body = li.systems.RigidBody(J)
    step, state = li.schemes.so3_midpoint(body, kappa, iterations=8), body.state(q, angular_velocity=Omega)
    (after, info), L = step(state, dt), linearization(step, state, dt)
    omega = body.phase_space.omega
    tau, Pi = li.maps.scaled_cayley(step.kappa), [body.body_momentum(z) for z in (state, after)]
    bar = dt * (Pi[0] + Pi[1]) / (2 * J)
    H, T = li.maps.derivative(tau, so3, bar), so3.to_matrix(tau(so3, bar))
    defect = jnp.abs(L.T @ omega(after) @ L - omega(state)).max()
    return info.converged, Pi, T, H, defect, jnp.abs(L).max()


def linearized(name, J, Omega, dt, q=(1.0, 0.0, 0.0, 0.0)):
    return jax.device_get(_linearized(np.array(J), np.array(q), np.array(Omega), dt, KAPPAS[name]))


@pytest.mark.slow
@pytest.mark.parametrize("name", KAPPAS)
@pytest.mark.parametrize(
    ("J", "Omega"), [([1.0, 2, 3], [0.2, 0, 1]), ([1.0, 1, 2], [0.4, 0.1, 0.6]), ([1.0, 1, 1], [0.4, 0.1, 0.6])]
)
def test_result_04_symplectic_if_and_only_if_condition_3_5(name, J, Omega):
    """Both vanish together or neither does. For the spherical body both vanish for every κ."""
    dt = 0.4
    converged, (Pi0, Pi1), T, H, defect, _ = linearized(name, J, Omega, dt)
    assert converged
    residual = np.abs(4 / dt * paper.skew((T + ONE) @ np.linalg.inv(H).T @ np.diag(J)) - hat(Pi0) + hat(Pi1)).max()
    exact = name == "symplectic" or J == [1.0, 1, 1]
    if exact:
        assert residual < 1e-14  # floor 3e-15
        assert defect < 4e-15  # floor 9e-16
    else:
        assert residual > 5e-3  # least of all: 0.01 and 0.001
        assert defect > 5e-4


@pytest.mark.paper("3.2: (3.15)–(3.25), Result 5", "the symplectic κ", "schemes/_so3_midpoint.py")
@hypothesis.given(moments, st.tuples(number, number, number, st.floats(0.2, 1)), directions, turns, signs)
def test_result_05_symplectic_kappa_preserves_the_form(J, q, axis, turn, sign):
    converged, *_, defect, size = linearized("symplectic", J, axis, sign * turn, np.array(q) / np.linalg.norm(q))
    hypothesis.assume(bool(converged))
    assert defect < 6e-15 * size**2  # floor 1.5e-15


@pytest.mark.long
@pytest.mark.parametrize(("name", "printed"), [("cayley", 2.5e-5), ("exponential", 1.7e-5)])
def test_result_05_refutation_cayley_and_exponential_are_not_symplectic(name, printed):
    """Their defect is O(Δt³) per step."""
    coarse, fine = (linearized(name, [1.0, 2.0, 3.0], [0.2, 0.0, 1.0], dt)[-2] for dt in (0.05, 0.025))
    assert coarse == pytest.approx(printed, rel=0.03)
    assert np.log2(coarse / fine) == pytest.approx(3, abs=0.01)


def test_result_05_time_step_bound_on_a_principal_axis():
    """The branch of the symplectic κ ends at Δt|Ω| = 1, where a step turns by 90°."""
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    plain = li.schemes.so3_midpoint(body)

    @jax.jit
    def turned(state, dt):
        after, info = li.schemes.so3_midpoint(body, iterations=12)(state, dt)
        return so3.angle(state.q, after.q), info.converged

    for axis in np.eye(3):
        state = li.State(np.array([1.0, 0, 0, 0]), np.array([1.0, 2, 3]) * axis)  # Ω along the axis, of length 1
        angle, converged = turned(state, 0.999)
        assert converged
        assert angle == pytest.approx(np.arcsin(0.999), abs=1e-12)  # arcsin|Θ̄|
        for dt in (1.001, 1.3, 2.0, 10.0):
            assert not turned(state, dt)[1]
            with pytest.raises(ValueError, match=r"\|Δt Ω\| = .*smaller dt"):
                plain.check(state, dt)


def test_result_05_off_axis_the_branch_reaches_further():
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    step = li.schemes.so3_midpoint(body, iterations=30)
    rng = np.random.default_rng(0)
    Omega = rng.normal(size=(4000, 3))
    Omega /= np.linalg.norm(Omega, axis=1, keepdims=True)

    @jax.jit
    def converged(dt):
        return jax.vmap(lambda v: step(body.state(angular_velocity=v), dt)[1].converged)(Omega)

    share = [np.mean(converged(dt)) for dt in (0.98, 1.1, 1.2)]
    assert share[0] == 1
    assert 0 < share[1] < 1
    assert share[2] == 0  # for this body it ends at 1.18
