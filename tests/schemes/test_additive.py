"""Section 6: Results 12, 13, 15 and 16 as theorems, each with its refutation, and the rules of `schemes.additive`.

Steps are compiled once a rule and called one by one: compiling a run of them would take longer than the run.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper import hat, rot
from repeated import once
from scipy.linalg import eigh
from scipy.optimize import root

import lieint_jax as li
from lieint_jax._numerics import vectors
from lieint_jax.core import State
from lieint_jax.diagnostics import linearization

BALL = li.systems.pseudo_rigid_body(2 * np.eye(3), li.systems.mooney_rivlin(2000.0, 6.0))
E = np.array([[1.0, 0.1, 0], [0.1, 1.5, -0.2], [0, -0.2, 2.5]])
SOFT = li.systems.pseudo_rigid_body(E, li.systems.mooney_rivlin(40.0, 6.0))
F0 = np.array([[1.1, 0.02, 0.0], [0.0, 0.95, 0.05], [-0.03, 0.0, 1.0]])
P0 = np.array([[0.3, -1.0, 0.2], [0.8, 0.1, 0.5], [-0.4, 0.6, -0.2]])
SOFT_STATE = SOFT.state(F0, momentum=P0)
OMEGA = np.block([[np.zeros((9, 9)), np.eye(9)], [-np.eye(9), np.zeros((9, 9))]])  # (6.1)


def additive(body, rule="average", **options):
    return li.schemes.additive(body, rule, **options)


def run(step, state, dt, num_steps):
    """Energies, momenta and flags along a run."""
    states, flags = [state], []
    for _ in range(num_steps):
        state, info = once(step, state, dt)
        states.append(state)
        flags.append(info.converged)
    stacked = jax.tree.map(lambda *x: np.stack(x), *states)  # 4000 arguments take jnp.stack a minute
    H, Phi = (np.array(jax.jit(jax.vmap(f))(stacked)) for f in (step.system.energy, step.system.momentum))
    return H, Phi, np.array(flags), state


def spinning(Phi):
    """F = 1 and P = π̂: the initial states of Figures 3 and 4."""
    return BALL.state(angular_velocity=[0.0, 0.0, Phi / 2])


# Section 6 in the paper's letters, on numpy matrices, solved by scipy -------------------------------------------------


def gradient(C, lam=40.0, mu=6.0):
    """∇W(C) of the figures' material"""
    return ((lam - (lam + mu) / np.linalg.det(C)) * np.linalg.det(C) * np.linalg.inv(C) + mu * np.eye(3)) / 2


def stored(C, lam=40.0, mu=6.0):
    I3 = np.linalg.det(C)
    return lam / 2 * (I3 - 1 - np.log(I3)) + mu / 2 * (np.trace(C) - 3 - np.log(I3))


def energy(F, P):
    return np.trace(P.T @ P @ np.linalg.inv(E)) / 2 + stored(F.T @ F)


def paper_step(F, P, dt, force, condition=None, beta=0.5, gamma=0.3):
    """(6.5) with 𝓕 = force(F_n, F_{n+1}, γ), and the equation `condition` for γ if there is one."""

    def residual(x):
        F1 = F + x[:9].reshape(3, 3)
        P1 = P + dt * force(F, F1, x[9])
        motion = F1 - F - dt * (beta * P1 + (1 - beta) * P) @ np.linalg.inv(E)
        return [*motion.ravel(), condition(F, F1, x[9]) if condition else x[9] - gamma]

    guess = [*(dt * P @ np.linalg.inv(E)).ravel(), gamma]
    found = root(residual, guess, method="hybr", options={"xtol": 1e-14})
    assert np.abs(residual(found.x)).max() < 1e-12
    F1 = F + found.x[:9].reshape(3, 3)
    return F1, P + dt * force(F, F1, found.x[9]), found.x[9]


def along(F, F1, gamma):
    """C_{n+γ} (6.12)"""
    return gamma * F1.T @ F1 + (1 - gamma) * F.T @ F


def force_6_11(F, F1, gamma):
    return -(F + F1) @ gradient(along(F, F1, gamma))


def force_6_14(F, F1, gamma):
    return -(F + F1) / 2 @ (gradient(along(F, F1, gamma)) + gradient(along(F, F1, 1 - gamma)))


def condition_6_13(F, F1, gamma):
    D = F1.T @ F1 - F.T @ F
    return stored(F1.T @ F1) - stored(F.T @ F) - np.trace(gradient(along(F, F1, gamma)) @ D)


def condition_of_the_symmetrized(F, F1, gamma):
    return (condition_6_13(F, F1, gamma) + condition_6_13(F, F1, 1 - gamma)) / 2


# Results 12 and 13: identities of the class (6.5), whatever the force -------------------------------------------------


@pytest.mark.parametrize("beta", [0.0, 0.3, 0.5, 1.0])
def test_result_12_momentum_changes_by_the_moment_of_the_force_at_one_minus_beta(beta):
    """(6.7): rot[P₁F₁ᵀ] − rot[P₀F₀ᵀ] = Δt rot[𝓕 F_{n+(1−β)}ᵀ], so it is conserved if and only if that vanishes."""
    rng = np.random.default_rng(3)
    dt, force = 0.2, rng.normal(size=(3, 3))
    P1 = P0 + dt * force
    F1 = F0 + dt * (beta * P1 + (1 - beta) * P0) @ np.linalg.inv(E)
    F_at = (1 - beta) * F1 + beta * F0
    np.testing.assert_allclose(rot(P1 @ F1.T) - rot(P0 @ F0.T), dt * rot(force @ F_at.T), rtol=0, atol=1e-15)
    assert np.abs(rot(force @ F_at.T)).max() > 0.1


def test_result_13_kinetic_energy_changes_by_the_work_of_the_force():
    """β = ½: K₁ − K₀ = ⟨𝓕, F₁ − F₀⟩, which (6.10) sets equal to W₀ − W₁."""
    rng = np.random.default_rng(4)
    dt, force = 0.2, rng.normal(size=(3, 3))
    P1 = P0 + dt * force
    for beta, holds in ((0.5, True), (0.3, False)):
        F1 = F0 + dt * (beta * P1 + (1 - beta) * P0) @ np.linalg.inv(E)
        kinetic = [np.trace(P.T @ P @ np.linalg.inv(E)) / 2 for P in (P0, P1)]
        missed = kinetic[1] - kinetic[0] - np.sum(force * (F1 - F0))
        assert (abs(missed) < 1e-14) == holds


@pytest.mark.paper("6.2: (6.5)–(6.9), Result 15", "momentum for any symmetric stress", "schemes/_additive.py")
@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 1.0])
def test_result_15_momentum_for_any_symmetric_stress_and_any_alpha(alpha):
    """Even a constant S, which is consistent with nothing. With S not symmetric, or β = α ≠ ½, it is lost."""
    S = np.array([[3.0, 1, -2], [1, -1, 0.5], [-2, 0.5, 2]])

    def change(S, beta):
        def force(F, F1, _):
            return -((1 - alpha) * F + alpha * F1) @ S

        F1, P1, _ = paper_step(F0, P0, 0.1, force, beta=beta)
        return np.abs(rot(P1 @ F1.T) - rot(P0 @ F0.T)).max()

    assert change(S, 1 - alpha) < 1e-14
    assert change(S + hat(np.ones(3)), 1 - alpha) > 1e-3
    if alpha != 0.5:
        assert change(S, alpha) > 1e-3


LABELED = additive(SOFT, "symplectic", alpha=0.3)  # its static fields serve every α


@pytest.mark.paper("6.2: (6.15)–(6.17)", "the symplectic family", "schemes/_additive.py")
@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_6_17_is_symplectic_and_conserves_momentum_for_every_alpha(alpha):
    step = dataclasses.replace(LABELED, alpha=jnp.array(alpha))
    L = _linear(step, SOFT_STATE, 0.1)
    assert np.abs(L.T @ OMEGA @ L - OMEGA).max() < 2e-14  # floor 3e-15
    _, Phi, converged, _ = run(step, SOFT_STATE, 0.05, 100)
    assert converged.all()
    assert np.abs(Phi - Phi[0]).max() < 4e-14  # floor 6e-15


_linear = jax.jit(linearization)


def test_6_17_at_the_ends_is_explicit_symplectic_euler():
    """α = 0: the force at F_n; α = 1: at F_{n+1}."""
    dt, F, P = 0.05, F0, P0
    P1 = P - 2 * dt * F @ gradient(F.T @ F)
    F1 = F + dt * P1 @ np.linalg.inv(E)
    ours, _ = once(dataclasses.replace(LABELED, alpha=jnp.array(0.0)), SOFT_STATE, dt)
    np.testing.assert_allclose([ours.q, ours.p], [F1, P1], rtol=0, atol=2e-15)
    F1 = F + dt * P @ np.linalg.inv(E)
    P1 = P - 2 * dt * F1 @ gradient(F1.T @ F1)
    ours, _ = once(dataclasses.replace(LABELED, alpha=jnp.array(1.0)), SOFT_STATE, dt)
    np.testing.assert_allclose([ours.q, ours.p], [F1, P1], rtol=0, atol=2e-15)


@pytest.mark.parametrize(("alpha", "order"), [(0.5, 2), (0.3, 1), (1.0, 1)])
def test_6_17_is_second_order_and_symmetric_at_one_half_only(alpha, order):
    """Measured in test_orders.py."""
    made = additive(SOFT, "symplectic", alpha=alpha)
    assert (made.order, made.symmetric) == (order, order == 2)


REST = SOFT.state(np.eye(3), momentum=np.zeros((3, 3)))


@functools.cache
def vibrations():
    """ω² of the vibrations about rest: the eigenvalues of the second derivative of W(FᵀF) over E."""
    W = lambda F: SOFT.stored_energy(F.reshape(3, 3).T @ F.reshape(3, 3))  # noqa: E731
    return eigh(jax.jit(jax.hessian(W))(np.eye(3).ravel()), np.kron(np.eye(3), E), eigvals_only=True)


@pytest.mark.paper("6.2", "(6.17) with α ≠ ½: up to which step it is stable", "schemes/_additive.py")
@pytest.mark.long
@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_6_17_is_stable_below_2_over_1_less_2_alpha(alpha):
    """At rest its eigenvalues are those of an oscillator: λ + 1/λ = (2 − (α² + β²)x)/(1 + αβx), x = (Δtω)², β = 1 − α.

    So |λ| = 1 for all vibrations if and only if Δtω|1 − 2α| < 2 for the fastest. Observed 3e-15; α = ½: 2e-13.
    """
    step, squares = dataclasses.replace(LABELED, alpha=jnp.array(alpha)), vibrations()
    limit = 100 if alpha == 0.5 else 2 / abs(1 - 2 * alpha)
    for part, stable in ((0.5, True), (0.99, True), (1.01, alpha == 0.5)):
        dt = part * limit / np.sqrt(squares.max())
        values, x = np.linalg.eigvals(_linear(step, REST, dt)), np.repeat(dt**2 * squares, 2)
        expected = (2 - (alpha**2 + (1 - alpha) ** 2) * x) / (1 + alpha * (1 - alpha) * x)
        found = values + 1 / values
        np.testing.assert_allclose(np.sort(found), np.sort(expected), rtol=0, atol=1e-12 if alpha == 0.5 else 2e-14)
        assert (np.abs(values).max() < 1 + 1e-6) == stable  # 1 + 1e-8, as the six λ of rotations are 1; else over 1.1


@pytest.mark.paper("6.1.2: (6.4)", "momentum maps of pseudo-rigid bodies", "systems/_pseudo_rigid_body.py")
def test_6_4_the_momentum_map_is_twice_rot():
    """⟨P, ξ̂F⟩ = 2ξ·rot[PFᵀ], for the pairing tr PᵀV; without the 2 it is not the momentum of rotations."""
    xi = np.array([0.3, -1.0, 0.7])
    pairing = np.sum(P0 * (hat(xi) @ F0))
    assert pairing == pytest.approx(2 * xi @ rot(P0 @ F0.T), abs=1e-15)
    assert pairing != pytest.approx(xi @ rot(P0 @ F0.T), abs=0.1)
    np.testing.assert_allclose(SOFT.momentum(SOFT_STATE), rot(P0 @ F0.T), rtol=0, atol=1e-15)
    np.testing.assert_allclose(SOFT.angular_momentum(SOFT_STATE), 2 * rot(P0 @ F0.T), rtol=0, atol=1e-15)


@pytest.mark.long
def test_6_15_and_6_16_with_beta_of_6_9():
    """Ψ_n = αE⁻¹, and α ∂S/∂F_n = (1−α) ∂S/∂F_{n+1} for the stress of (6.17); as printed α and 1 − α are exchanged."""
    alpha, beta = 0.3, 0.7
    Psi = jax.jacfwd(lambda P: (beta * P0 + (1 - beta) * P) @ np.linalg.inv(E))(jnp.array(P0))
    np.testing.assert_allclose(Psi[0, :, 0, :].T, alpha * np.linalg.inv(E), rtol=0, atol=1e-15)

    def stress(F, F1):
        middle = alpha * F1 + (1 - alpha) * F
        return jnp.stack(SOFT.stored_energy.stress(vectors.matrix(middle).gram()))

    by_F, by_F1 = jax.jit(jax.jacfwd(stress, argnums=(0, 1)))(jnp.array(F0), jnp.array(F0 + 0.1 * P0))
    np.testing.assert_allclose(alpha * by_F, (1 - alpha) * by_F1, rtol=0, atol=1e-13)
    assert np.abs((1 - alpha) * by_F - alpha * by_F1).max() > 1


@pytest.mark.paper("6.2: (6.10)–(6.14), Result 16", "energy and momentum", "schemes/_additive.py")
@pytest.mark.long
@pytest.mark.parametrize("rule", ["average", "energy", "energy_momentum"])
def test_result_16_energy_and_momentum_reversible_not_symplectic(rule):
    step = additive(SOFT, rule)
    H, Phi, converged, _ = run(step, SOFT_STATE, 0.05, 300)
    assert converged.all()
    assert np.abs(H - H[0]).max() < 2e-13  # floor 4e-14, of energies of 2
    assert np.abs(Phi - Phi[0]).max() < 4e-14
    back, _ = once(step, once(step, SOFT_STATE, 0.05)[0], -0.05)
    apart = max(np.abs(back.q - SOFT_STATE.q).max(), np.abs(back.p - SOFT_STATE.p).max())
    assert step.symmetric
    assert apart < 1e-14
    assert _defect_by_differences(step, SOFT_STATE, 0.1) > 1e-4


def _defect_by_differences(step, state, dt, h=1e-5):
    def push(delta):
        end = once(step, State(state.q + delta[:9].reshape(3, 3), state.p + delta[9:].reshape(3, 3)), dt)[0]
        return np.concatenate([np.ravel(end.q), np.ravel(end.p)])

    L = np.stack([(push(h * e) - push(-h * e)) / (2 * h) for e in np.eye(18)], axis=1)
    return np.abs(L.T @ OMEGA @ L - OMEGA).max()


@pytest.mark.long
def test_the_midpoint_rule_loses_energy_and_none_of_the_form():
    step = dataclasses.replace(LABELED, alpha=jnp.array(0.5))
    H, _, _, _ = run(step, SOFT_STATE, 0.05, 300)
    assert 1e-4 < np.ptp(H) < 1
    assert _defect_by_differences(step, SOFT_STATE, 0.1) < 1e-8  # of differences


@pytest.mark.long
@pytest.mark.parametrize(
    ("rule", "force", "condition", "gamma"),
    [
        ("energy", force_6_11, condition_6_13, 0.5),
        ("energy_momentum", force_6_14, condition_of_the_symmetrized, 0.5 - 12**-0.5),
        ("symplectic", lambda F, F1, _: -(F + F1) @ gradient((F + F1).T @ (F + F1) / 4), None, 0.5),
    ],
)
def test_a_step_is_the_one_that_the_paper_s_equations_have(rule, force, condition, gamma):
    F1, P1, _ = paper_step(F0, P0, 0.1, force, condition, gamma=gamma)
    step = dataclasses.replace(LABELED, alpha=jnp.array(0.5)) if rule == "symplectic" else additive(SOFT, rule)
    ours, info = once(step, SOFT_STATE, 0.1)
    assert info.converged
    np.testing.assert_allclose([ours.q, ours.p], [F1, P1], rtol=0, atol=1e-10)  # scipy's own floor


@pytest.mark.long
def test_6_14_as_printed_loses_energy_and_with_the_symmetrized_condition_does_not():
    """γ of (6.13) put into the symmetrized force (6.14); the right γ tends to ½ − 1/√12."""
    lost = {}
    for name, condition in (("printed", condition_6_13), ("corrected", condition_of_the_symmetrized)):
        F, P, total = F0, P0, 0.0
        for _ in range(20):
            F1, P1, gamma = paper_step(F, P, 0.1, force_6_14, condition, gamma=0.2)
            total += abs(energy(F1, P1) - energy(F, P))
            F, P = F1, P1
        lost[name] = total
    assert lost["printed"] > 1e-4
    assert lost["corrected"] < 1e-11
    _, _, gamma = paper_step(F0, P0, 0.01, force_6_14, condition_of_the_symmetrized, gamma=0.2)
    assert gamma == pytest.approx(0.5 - 12**-0.5, abs=0.01)


def test_6_13_gamma_is_not_below_one_half():
    """The printed range [0, ½) is false: γ = ½ for quadratic W, and on either side of ½ for others."""
    rng = np.random.default_rng(5)
    gammas = []
    for _ in range(40):
        F, F1 = (np.eye(3) + 0.1 * rng.normal(size=(3, 3)) for _ in range(2))
        found = root(lambda g, F=F, F1=F1: condition_6_13(F, F1, g[0]), [0.5], options={"xtol": 1e-12})
        assert abs(condition_6_13(F, F1, found.x[0])) < 1e-13  # floor 7e-15; scipy may call round-off no success
        gammas.append(found.x[0])
    assert 10 < np.sum(np.array(gammas) > 0.5) < 30


@pytest.mark.long
@pytest.mark.parametrize(
    ("dt", "Phi", "most", "most_momentum"),  # floors 9e-14 and 3e-14, of H = 18; 4.2e-12 and 2e-13, of H = 50
    [(0.005, 6.0, 5e-13, 2e-13), (0.05, 10.0, 5e-12, 1e-12)],
    ids=["3c", "4c"],
)
def test_average_conserves_energy_and_momentum_in_the_runs_of_the_figures(dt, Phi, most, most_momentum):
    """λ = 2000 makes rounding visible. Of 4c it is a random walk of 5e-14 per step once the motion has lost its
    symmetry (|F| up to 3.6): a stress rounded otherwise or further Newton corrections end between 4e-12 and 6e-12 as
    well.
    """
    H, moments, converged, end = run(additive(BALL), spinning(Phi), dt, 4000)
    assert converged.all()
    assert np.abs(H - H[0]).max() < most
    assert np.abs(moments - moments[0]).max() < most_momentum
    assert np.linalg.det(end.q) > 0


@pytest.mark.long
def test_the_rules_with_gamma_are_flagged_where_they_fail():
    """At Figure 4's step (6.13) has no root near some steps' own: a flag, not a wrong number."""
    step = additive(BALL, "energy_momentum")
    H, Phi, converged, _ = run(step, spinning(6.0), 0.05, 60)
    assert not converged.all()
    first = np.flatnonzero(~converged)[0]
    assert np.abs(H[: first + 1] - H[0]).max() < 1e-12
    assert np.abs(Phi[: first + 1] - Phi[0]).max() < 1e-13


@pytest.mark.long
@pytest.mark.parametrize("W", ["user", "saint_venant_kirchhoff", "neo_hookean"])
def test_every_material_conserves_energy(W):
    """A user's W(C) by 8 Gauss nodes; St Venant–Kirchhoff by its midpoint; neo-Hookean by its invariants."""
    material = (lambda C: jnp.sum((C - jnp.eye(3)) ** 4) + 20 * (jnp.linalg.det(C) - 1) ** 2) if W == "user" else None
    body = li.systems.pseudo_rigid_body(E, material or getattr(li.systems, W)(40.0, 6.0))
    step = additive(body)
    H, Phi, converged, _ = run(step, body.state(F0, momentum=P0), 0.05, 300)
    assert converged.all()
    assert np.abs(H - H[0]).max() < 2e-13
    assert np.abs(Phi - Phi[0]).max() < 4e-14


@pytest.mark.long
def test_a_step_that_turns_the_body_inside_out_is_flagged():
    """The midpoint may stay in GL⁺(3) and F_{n+1} not; W(C) cannot see it."""
    step = dataclasses.replace(LABELED, alpha=jnp.array(0.5))
    collapse = SOFT.state(np.eye(3), velocity=-np.diag([1.0, 0.0, 0.0]) * 15)
    after, info = once(step, collapse, 0.3)
    assert not info.converged or np.linalg.det(after.q) > 0
    _, info = once(step, SOFT.state(F0, momentum=300 * P0), 2.0)
    assert not info.converged
    _, info = once(step, SOFT_STATE._replace(q=SOFT_STATE.q * jnp.nan), 0.1)
    assert not info.converged
    with pytest.raises(ValueError, match="does not converge within 25 iterations"):
        step.check(SOFT.state(F0, momentum=300 * P0), 2.0)
