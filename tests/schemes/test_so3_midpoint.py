"""The step itself: its two forms, its derivatives, its batches, its order, what it does with bad input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest
import scipy.integrate
import slopes
from equations import euler
from repeated import after

import lieint_jax as li
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)
BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = jax.jit(BODY.state)(np.array([1.0, 2, -1, 0.5]) / 2.5, angular_velocity=[0.3, -0.5, 0.8])
angle, body_momentum = jax.jit(so3.angle), jax.jit(BODY.body_momentum)


def dop853(J, q, p, t):
    """Another package's solution: quaternion kinematics and Euler's equations in the body."""
    rate = euler(np.asarray(J), lambda t, q, Omega: np.zeros(3))
    y = np.concatenate([q, np.array(body_momentum(li.State(q, p))) / J])
    out = scipy.integrate.solve_ivp(rate, (0, t), y, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return out[:4], J * out[4:]


def test_the_reference_flow_agrees_with_another_package():
    q, Pi = dop853([1.0, 2, 3], STATE.q, STATE.p, 10.0)
    end = jax.jit(lambda z: li.diagnostics.flow(BODY, z, 10.0, 20))(STATE)
    np.testing.assert_allclose(end.q, q, rtol=0, atol=2e-12)  # DOP853's own error
    np.testing.assert_allclose(body_momentum(end), Pi, rtol=0, atol=5e-12)


def test_scalar_and_vector_forms_agree_to_round_off():
    """Two ways to the same root, at steps up to the branch; and a full tensor turned to its axes is the same body."""
    vector = dataclasses.replace(kappa_symplectic, solve_by="vector")
    for dt in (0.05, -0.3, 0.6, 0.9):
        a, b = (after(li.schemes.so3_midpoint(BODY, k, iterations=8), STATE, dt, 1) for k in (kappa_symplectic, vector))
        assert a[1].converged
        assert b[1].converged
        np.testing.assert_allclose(a[0].q, b[0].q, rtol=0, atol=2e-15)


@pytest.mark.long
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_full_inertia_is_the_same_body_in_other_axes(kappa):
    @jax.jit
    def both(other):
        """The inertia and the state in axes that are turned, and energies; and what `other` is in the first axes."""
        turn = so3.exp(jnp.array([0.4, -0.2, 0.7]))
        R = so3.to_matrix(turn)
        full = li.systems.RigidBody(R @ jnp.diag(BODY.inertia) @ R.T)
        state = li.State(so3.multiply(STATE.q, so3.inverse(turn)), STATE.p)
        return full, state, full.energy(state), BODY.energy(STATE), so3.multiply(other, turn)

    full, state, *energies, _ = both(STATE.q)
    assert energies[0] == pytest.approx(float(energies[1]), rel=1e-15, abs=0)
    a, _ = after(li.schemes.so3_midpoint(full, kappa), state, 0.3, 1)
    b, _ = after(li.schemes.so3_midpoint(BODY, kappa), STATE, 0.3, 1)
    assert angle(both(a.q)[-1], b.q) < 2e-15


def test_the_symplectic_step_is_the_discrete_moser_veselov_map():
    """The symplectic step is the discrete Moser–Veselov map: M = ωᵀJd − Jdω, ω the transposed rotation of the step."""
    end, _ = after(li.schemes.so3_midpoint(BODY), STATE, 0.3, 1)
    R = np.array(jax.jit(lambda a, b: so3.to_matrix(so3.multiply(so3.inverse(a), b)))(STATE.q, end.q))
    J = np.diag(BODY.inertia)
    Jd = np.trace(J) / 2 * np.eye(3) - J
    M = R @ Jd - Jd @ R.T
    momenta = [np.array(body_momentum(z)) for z in (STATE, end)]
    assert np.abs(M - paper.hat(0.3 * momenta[0])).max() < 2e-15
    assert np.abs(R.T @ M @ R - paper.hat(0.3 * momenta[1])).max() < 2e-15


def loss(J, z, dt, kappa):
    body = li.systems.RigidBody(J)
    end, _ = li.schemes.so3_midpoint(body, kappa, iterations=4)(z, dt)
    return end.q[1] + 2 * end.q[3] * end.p[0] + body.energy(end)


@pytest.mark.parametrize("kappa", [kappa_symplectic, kappa_cayley], ids=lambda k: k.name)
def test_the_energy_has_no_slope(kappa):
    """Observed (2 ± 3)e-5 and (6 ± 3)e-5 eps a step. Functions of J alone are rounded in the same way in each step:
    with them the slope was -1.2e-3 by the scalar form (tr, adj and det), -6e-4 by the vector form (J₃ − J₁).
    """
    states = jax.vmap(lambda Omega: BODY.state(angular_velocity=Omega))(np.random.default_rng(1).normal(size=(256, 3)))
    run = li.run(li.schemes.so3_midpoint(BODY, kappa), states, 0.1, 100_000, save_every=None, progress=False)
    start, end = (np.array(jax.vmap(BODY.energy)(z)) for z in (states, jax.tree.map(lambda x: x[-1], run.state)))
    assert abs(np.mean(end / start - 1)) < 1.5e-4 * 100_000 * np.finfo(float).eps


@pytest.mark.long
def test_nested_derivatives_agree_in_either_order():
    """Forward over reverse and reverse over forward agree: the Hessian in the inertia, which is symmetric."""

    def f(J):
        return loss(J, STATE, 0.3, kappa_symplectic)

    columns = (
        jax.jit(lambda J, v: jax.jvp(jax.grad(f), (J,), (v,))[1]),
        jax.jit(lambda J, v: jax.grad(lambda J: jax.jvp(f, (J,), (v,))[1])(J)),
    )
    hessians = [np.stack([column(BODY.inertia, e) for e in np.eye(3)]) for column in columns]
    np.testing.assert_allclose(*hessians, rtol=0, atol=1e-14)
    np.testing.assert_allclose(hessians[0], hessians[0].T, rtol=0, atol=1e-14)


@pytest.mark.long
def test_the_derivative_by_a_parameter_of_kappa_agrees_with_differences():
    """A κ with a parameter of its own is a Partial; its derivative goes through the step's leaves."""
    kappa = jax.tree_util.Partial(lambda c, x: 1 + c * x, 0.2)
    slopes.assert_agree(li.schemes.so3_midpoint(BODY, kappa, iterations=6), STATE, 0.3)


@pytest.mark.long
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_a_body_at_rest_has_finite_values_and_derivatives(kappa):
    """No momentum, no step, no 0/0: and it converges."""
    rest = li.State(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    for state, dt in ((rest, 0.1), (STATE, 0.0)):
        end, info = after(li.schemes.so3_midpoint(BODY, kappa), state, dt, 1)
        assert info.converged
        np.testing.assert_allclose(end.q, state.q, rtol=0, atol=2e-16)
        for derivative in (jax.grad, jax.jacfwd):
            found = jax.jit(derivative(loss, (0, 1, 2)))(BODY.inertia, state, dt, kappa)
            assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))


@pytest.mark.long
def test_vmap_over_states_steps_and_inertias():
    rng = np.random.default_rng(2)
    J, q, Omega = rng.uniform(1, 1.9, (8, 3)), rng.normal(size=(8, 4)), rng.uniform(-1, 1, (8, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    dts = np.linspace(-0.3, 0.3, 8)

    def build(J, q, Omega):
        body = li.systems.rigid_body(J)
        return li.schemes.so3_midpoint(body), body.state(q, angular_velocity=Omega)

    @jax.jit
    def all_at_once(J, q, Omega, dts):
        steps, states = jax.vmap(build)(J, q, Omega)
        return states, jax.vmap(lambda s, z, dt: s(z, dt))(steps, states, dts)

    states, (batch, info) = jax.device_get(all_at_once(J, q, Omega, dts))
    assert info.converged.all()
    for k in range(8):
        step = li.schemes.so3_midpoint(li.systems.rigid_body(J[k]))
        one, _ = after(step, li.State(states.q[k], states.p[k]), dts[k], 1)
        np.testing.assert_allclose(batch.q[k], one.q, rtol=0, atol=4e-16)


def test_building_the_step_again_hits_the_same_jit_cache():
    count = 0

    @jax.jit
    def advance(step, state):
        nonlocal count
        count += 1
        return step(state, 0.1)

    for J in ([1.0, 2, 3], [1.0, 1, 2]):
        advance(li.schemes.so3_midpoint(li.systems.rigid_body(J), kappa_symplectic), STATE)
    assert count == 1


def test_inside_jit_a_failure_is_a_flag_never_an_exception_never_silent():
    @jax.jit
    def f(dt):
        return li.schemes.so3_midpoint(BODY)(STATE, dt)

    assert f(0.2)[1].converged
    for dt in (1.5, 3.0, 100.0, np.nan, np.inf):
        assert not f(dt)[1].converged


@pytest.mark.slow
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_every_nan_comes_with_the_flag(kappa):
    step = li.schemes.so3_midpoint(BODY, kappa)
    dts = np.concatenate([np.linspace(-20, 20, 2001), [np.nan, np.inf, -np.inf]])

    @jax.jit
    @jax.vmap
    def all_of_them(dt):
        state, info = step(STATE, dt)
        return state.q, info.converged, BODY.energy(state) / BODY.energy(STATE) - 1

    q, good, energy = map(np.asarray, all_of_them(dts))
    assert 0 < good.sum() < len(good)
    assert np.isfinite(q[good]).all()
    assert np.abs(energy[good]).max() < 1e-14  # whatever is called converged is right


@pytest.mark.long
@pytest.mark.parametrize(
    ("J", "Omega", "dt", "kappa"),
    [
        ([1.0, 5, 5.9], [-1.20794800e-03, 9.99999231e-01, -2.82142517e-04], 1.84, kappa_exponential),
        ([1.0, 2, 3], [0.091, 0.995, 0.050], 2.298, kappa_exponential),
        ([0.01, 1, 1.005], [-0.0745, 0.9938, -0.0824], 4.159, kappa_cayley),
    ],
)
def test_a_root_past_a_fold_of_the_branch_is_not_called_converged(J, Omega, dt, kappa):
    """Newton finds another root there, with residual 0: det K < 0 tells it from the branch that starts at Δt = 0."""
    body = li.systems.rigid_body(J)
    state = li.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array(J) * Omega)
    assert not after(li.schemes.so3_midpoint(body, kappa, iterations=8), state, dt, 1)[1].converged


@pytest.mark.long
@pytest.mark.parametrize("kappa", [kappa_cayley, kappa_exponential], ids=lambda k: k.name)
def test_converged_roots_are_those_of_the_branch_from_zero(kappa):
    """Against continuation in 60 increments of dt, each from the root before, near the intermediate axis."""
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    rng = np.random.default_rng(8)
    Omega = np.array([0.0, 1.0, 0.0]) + 0.1 * rng.normal(size=(300, 3))
    step = li.schemes.so3_midpoint(body, kappa, iterations=8)
    J, name = np.array([1.0, 2, 3]), kappa.name

    def branch(Omega, dt, bar):
        """Newton on (3.4) in Θ̄ with numpy, from a nearby root."""
        for _ in range(6):
            k, dk = (f(bar @ bar) for f in paper.KAPPAS[name])
            F = J * bar + k / 2 * np.cross(bar, J * bar) - dt * J * Omega
            K = (
                np.diag(J)
                + k / 2 * (paper.hat(bar) @ np.diag(J) - paper.hat(J * bar))
                + dk * np.outer(np.cross(bar, J * bar), bar)
            )
            bar = bar - np.linalg.solve(K, F)
        return bar

    end = 2.6 if kappa is kappa_exponential else 3.9
    one = np.array([1.0, 0.0, 0.0, 0.0])
    steps = [after(step, li.State(one, J * v), end, 1) for v in Omega]
    good = np.flatnonzero([info.converged for _, info in steps])
    assert 5 < len(good) < 300
    for m in good[:4]:
        bar = end / 60 * Omega[m]
        for dt in np.linspace(0, end, 61)[1:]:
            bar = branch(Omega[m], dt, bar)
        half = paper.KAPPAS[name][0](bar @ bar) * bar / 2  # cay Θ is the quaternion 1 + ½Θ, normalized
        exact = np.array([1, *half]) / np.sqrt(1 + half @ half)
        assert angle(exact, steps[m][0].q) < 1e-12


@pytest.mark.long
def test_advice_for_rods_names_the_vector_form():
    rod = li.systems.rigid_body([1.0, 1.0, 1e-4])
    state = rod.state(angular_velocity=[0.5846, 0.8113, 4e-6])  # residual 1e-7, far above its bound of 7e-16
    step = li.schemes.so3_midpoint(rod)
    assert not step(state, 0.5)[1].converged
    with pytest.raises(ValueError, match="slender body the vector form"):
        step.check(state, 0.5)
    vector = dataclasses.replace(kappa_symplectic, solve_by="vector")
    assert after(li.schemes.so3_midpoint(rod, vector), state, 0.5, 1)[1].converged


def test_advice_for_the_symplectic_kappa_names_its_limit_in_either_form():
    vector = dataclasses.replace(kappa_symplectic, solve_by="vector")
    for kappa, ends in ((kappa_symplectic, "ends at"), (vector, "ends at"), (kappa_cayley, "folds at")):
        step = li.schemes.so3_midpoint(BODY, kappa)
        assert f"the branch of this κ {ends} |Δt Ω|" in step.advice(STATE, 2.0)
