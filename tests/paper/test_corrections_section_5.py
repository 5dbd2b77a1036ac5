"""Section 5.4, Appendix B: Results 12 and 14 with random forces; the printed forms wrong, the corrected ones right."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper import skew

import lieint_jax as li
from lieint_jax import _discover, groups, maps
from lieint_jax._numerics import newton
from lieint_jax.core import State, Step, StepInfo, pytree
from lieint_jax.core.tangent import value_and_jacobian

MATRIX = _discover.modules_with("examples", groups)["matrix"]
QUICK = {"xla_llvm_disable_expensive_passes": True}
DT = 0.3


@pytree
class General(Step):
    """(5.43) with Θ = Ψ_nΠ_n + Ψ_{n+1}Π_{n+1} and a force without any structure."""

    system: li.systems.Euler
    Psi: jax.Array
    W: jax.Array
    order, symmetric, name = 1, False, "general"

    def force(self, q, theta):
        return self.W[0] @ jnp.sin(jnp.ravel(q))[: self.system.group.dim] + self.W[1] @ jnp.sin(theta + 1) * q[0, 0]

    def solve(self, state, dt):
        g = self.system.group

        def residual(theta):
            pi = state.p + dt * self.force(state.q, theta)
            after = g.Ad_star(g.multiply(state.q, g.exp(theta)), pi)
            return theta - self.Psi[0] @ g.Ad_star(state.q, state.p) - self.Psi[1] @ after

        def correction(theta, F):
            return jnp.linalg.solve(jax.jacfwd(residual)(theta), F)

        return newton.root(residual, correction, 2 * self.Psi[0] @ g.Ad_star(state.q, state.p), 12, unroll=False)[:2]

    def report(self, state, dt):
        """The state after a step, its report, and Θ."""
        g = self.system.group
        theta, F = self.solve(state, dt)
        after = State(g.multiply(state.q, g.exp(theta)), state.p + dt * self.force(state.q, theta))
        return after, (StepInfo(jnp.max(jnp.abs(F)), jnp.max(jnp.abs(F)) < 1e-14), theta)

    def advance(self, state, dt):
        after, (info, _) = self.report(state, dt)
        return after, info


@functools.cache
def one_step():
    """Every matrix of (6.33)–(6.40) for one step on SL(2), from random Ψ's and a random force."""
    rng = np.random.default_rng(4)
    basis = groups.special_linear(2).basis
    g = MATRIX.MatrixGroup(basis, "SL(2)", unrolled=False)
    system = li.systems.euler(g, np.array([1.0, 2.0, 3.0]))
    step = General(system, jnp.array(rng.normal(size=(2, 3, 3)) / 8), jnp.array(rng.normal(size=(2, 3, 3)) / 2))

    @functools.partial(jax.jit, compiler_options=QUICK)
    def everything(turn):
        state = system.state(g.exp(turn), velocity=[0.5, -0.4, 0.6])
        after, (info, theta), L = value_and_jacobian(system.phase_space, lambda z: step.report(z, DT), state)
        eye = jnp.eye(3)
        columns = lambda q: jax.vmap(g.Ad, (None, 1), 1)(q, eye)  # noqa: E731
        ad_star = lambda mu: jax.vmap(g.ad_star, (1, None), 1)(eye, mu)  # noqa: E731
        moved = lambda x: g.multiply(g.exp(x), state.q)  # noqa: E731
        zero = jnp.zeros(3)
        Pi0, Pi1, F = system.body_momentum(state), system.body_momentum(after), step.force(state.q, theta)
        return {
            "converged": info.converged, "Theta": theta, "Pi0": Pi0, "Pi1": Pi1, "pi0": state.p, "force": F,
            "Ad0": columns(state.q), "Ad1": columns(after.q), "back": columns(g.exp(-theta)),
            "H": maps.derivative(maps.exponential, g, theta),
            "F": jax.jacfwd(lambda x: step.force(moved(x), theta))(zero),
            "G": jax.jacfwd(lambda x: step.force(state.q, x))(theta),
            "alpha0": ad_star(state.p), "alpha1": ad_star(after.p), "A0": ad_star(Pi0), "A1": ad_star(Pi1),
            "ad_force": ad_star(F), "L": L,
        }  # fmt: skip

    o = {k: np.array(v) for k, v in everything(np.array([0.2, -0.3, 0.4])).items()}
    assert o["converged"]
    Psi = np.array(step.Psi)
    o |= {"Psi0": Psi[0], "Psi1": Psi[1]}
    one, zero = np.eye(3), np.zeros((3, 3))
    A = [DT * o["G"] @ Psi[0] @ o["Ad0"].T, -DT * o["G"] @ Psi[1] @ o["Ad1"].T]
    B = [o["Ad1"] @ o["H"] @ Psi[0] @ o["Ad0"].T, -o["Ad1"] @ o["H"] @ Psi[1] @ o["Ad1"].T]
    a = [o["alpha0"], o["alpha1"]]
    L0 = np.block([[one + B[0] @ a[0], B[0]], [A[0] @ a[0] + DT * o["F"], one + A[0]]])
    L1 = np.block([[one + B[1] @ a[1], B[1]], [A[1] @ a[1], one + A[1]]])
    P = [np.block([[zero, -one], [one, x]]) for x in a]
    M = np.linalg.solve(o["H"], Psi[1].T + o["back"] @ Psi[0].T)
    D = Psi[1] @ o["A1"] @ Psi[1].T - Psi[0] @ o["A0"] @ Psi[0].T
    return o | {"A": A, "B": B, "L0": L0, "L1": L1, "P": P, "M": M, "D": D, "R": L0 @ P[0] @ L0.T - L1 @ P[1] @ L1.T}


def close(a, b, bound=2e-14):
    assert np.abs(np.asarray(a) - np.asarray(b)).max() < bound


def apart(a, b):
    assert np.abs(np.asarray(a) - np.asarray(b)).max() > 1e-3


@pytest.mark.paper("App. B: (6.33)–(6.46)", "Result 14", "diagnostics/_conditions.py")
@pytest.mark.long
def test_6_24_6_34_the_linearized_step():
    """Against autodiff; (6.24) with Ad_{q_{n+1}} HδΘ, not Ad*: then B_n would have its transpose in front."""
    o = one_step()
    close(o["L"], np.linalg.solve(o["L1"], o["L0"]), 1e-13)
    wrong = [sign * o["Ad1"].T @ o["H"] @ o[f"Psi{k}"] @ o[f"Ad{k}"].T for k, sign in ((0, 1), (1, -1))]
    one, a = np.eye(3), (o["alpha0"], o["alpha1"])
    L0 = np.block([[one + wrong[0] @ a[0], wrong[0]], [o["L0"][3:]]])
    L1 = np.block([[one + wrong[1] @ a[1], wrong[1]], [o["L1"][3:]]])
    apart(o["L"], np.linalg.solve(L1, L0))


def test_result_14_condition_1_has_no_dt():
    """(6.42) with its minus, (6.43), and with 2, not 2/Δt as printed in the result."""
    o = one_step()
    carry = o["Ad1"] @ o["H"]
    close(skew(o["B"][1] - o["B"][0]), -carry @ skew(o["M"].T) @ carry.T)
    apart(skew(o["B"][1] - o["B"][0]), carry @ skew(o["M"].T) @ carry.T)
    close(o["B"][1] @ o["alpha1"] @ o["B"][1].T - o["B"][0] @ o["alpha0"] @ o["B"][0].T, carry @ o["D"] @ carry.T)
    close(-o["R"][:3, :3], carry @ (2 * skew(o["M"]) - o["D"]) @ carry.T)
    apart(-o["R"][:3, :3], carry @ (2 / DT * skew(o["M"]) - o["D"]) @ carry.T)


@pytest.mark.paper("5.4: (5.50)–(5.53), Result 14", "the conditions of the form", "diagnostics/_conditions.py")
def test_result_14_conditions_2_and_3():
    """The whole test (6.37) in terms of the three conditions' residuals S: zero if and only if all three are."""
    o = one_step()
    S1 = 2 * skew(o["M"]) - o["D"]
    S2 = o["G"] @ o["M"] - o["F"] @ o["Ad0"] @ o["Psi0"].T
    printed = o["G"] @ o["M"] - o["F"] @ o["Ad0"].T @ o["Psi0"].T  # Ad*_{q_n} of (6.45)
    S3 = o["ad_force"] + 2 * skew(o["F"])
    carry = (o["Ad1"] @ o["H"]).T
    close(o["R"][3:, :3], DT * (S2 - o["G"] @ S1) @ carry)
    apart(o["R"][3:, :3], DT * (printed - o["G"] @ S1) @ carry)
    close(o["R"][3:, 3:], -DT * S3 + 2 * DT**2 * skew(S2 @ o["G"].T) - DT**2 * o["G"] @ S1 @ o["G"].T)
    close(DT * o["F"] @ o["A"][0].T, DT**2 * o["F"] @ o["Ad0"] @ o["Psi0"].T @ o["G"].T)  # the last but one of (6.46)
    apart(DT * o["F"] @ o["A"][0].T, DT**2 * o["F"] @ np.linalg.inv(o["Ad0"]).T @ o["Psi0"].T @ o["G"].T)


def test_result_14_midpoint_form():
    """1′ with m and 2′ with Ad_{q_n} in front: what the general conditions say for Ψ = ½Δt m⁻¹."""
    o, m = one_step(), np.diag([1.0, 2.0, 3.0])
    Psi, one = DT / 2 * np.linalg.inv(m), np.eye(3)
    M = np.linalg.solve(o["H"], (one + o["back"]) @ Psi)
    S1 = 2 * skew(M) - Psi @ (o["A1"] - o["A0"]) @ Psi
    right = 4 / DT * skew(m @ np.linalg.inv(o["H"]) @ (one + o["back"])) - (o["A1"] - o["A0"])
    printed = 4 / DT * skew(np.linalg.inv(o["H"]) @ (one + o["back"])) - (o["A1"] - o["A0"])
    close(4 / DT**2 * m @ S1 @ m, right, 1e-12)
    apart(4 / DT**2 * m @ S1 @ m, printed)
    half = np.linalg.solve(one + o["back"], o["H"])
    close(o["F"] @ o["Ad0"] @ half @ M, o["F"] @ o["Ad0"] @ Psi)
    apart(o["F"] @ half @ o["Ad0"] @ M, o["F"] @ o["Ad0"] @ Psi)


def test_result_14_abelian_form():
    """3″ is skew[∂𝓕/∂q_n + ∂𝓕/∂q_{n+1}] = 0: a symplectic step whose ∂𝓕/∂q_n alone is not symmetric."""
    rng = np.random.default_rng(1)
    S, N, V = rng.normal(size=(3, 3, 3))
    S, N, V = (S + S.T) / 8 + 2 * np.eye(3), N / 2, (V + V.T) / 4  # well conditioned
    Psi = [S / 2 + N, S / 2 - N]  # 1″ with H = 1: the sum is symmetric
    J = np.block([[np.zeros((3, 3)), -np.eye(3)], [np.eye(3), np.zeros((3, 3))]])

    def defect(F0, F1):
        """q₁ = q₀ + Ψ₀p₀ + Ψ₁p₁, p₁ = p₀ + Δt(F₀q₀ + F₁q₁)."""
        one = np.eye(3)
        after = np.block([[one, -Psi[1]], [-DT * F1, one]])
        before = np.block([[one, Psi[0]], [DT * F0, one]])
        L = np.linalg.solve(after, before)
        return np.abs(L @ J @ L.T - J).max()

    F1 = V @ np.linalg.inv(np.linalg.solve(Psi[0], Psi[1]).T + np.eye(3))
    F0 = V - F1
    close(F0 @ Psi[0].T, F1 @ Psi[1].T)  # 2″
    assert np.abs(skew(F0)).max() > 1e-2  # 3″ as printed does not hold
    assert defect(F0, F1) < 4e-15  # floor 3e-16
    F0, F1 = np.eye(3), np.linalg.solve(Psi[1], Psi[0]).T  # 3″ as printed, and 2″: not symplectic
    close(F0 @ Psi[0].T, F1 @ Psi[1].T)
    assert np.abs(skew(F0 + F1)).max() > 1e-2
    assert defect(F0, F1) > 1e-3


def test_5_32_the_half_stands_before_both_terms():
    """⟨μ, skew[M]ν⟩ is ½(⟨μ, Mν⟩ − ⟨ν, Mμ⟩): with it the arcsine map on SL(2), which is symplectic, has (5.31)."""
    g, metric, theta = groups.special_linear(2), np.diag([1.0, 2.0, 3.0]), np.array([0.2, -0.3, 0.25])

    @jax.jit
    def sides(theta):
        one = jnp.eye(3)
        back = jax.vmap(g.Ad, (None, 1), 1)(maps.arcsine(g, -theta), one)
        M = metric @ jnp.linalg.solve(maps.derivative(maps.arcsine, g, theta), one + back)
        momentum = jnp.linalg.solve(one + back.T, metric @ theta) - metric @ theta / 2  # (5.33)
        right = jax.vmap(g.ad_star, (1, None), 1)(one, momentum)
        return M, right, maps.symplectic_residual(maps.arcsine, g, metric, theta)

    M, right, residual = jax.device_get(sides(theta))
    assert residual < 1e-14
    mu, nu = np.random.default_rng(0).normal(size=(2, 3))
    close((mu @ M @ nu - nu @ M @ mu) / 2, mu @ right @ nu)
    apart(mu @ M @ nu / 2 - nu @ M @ mu, mu @ right @ nu)  # as printed


@pytest.mark.paper("App. B: (6.18)–(6.23)", "energy on a group", "diagnostics/_conditions.py")
def test_6_18_6_21_6_23_the_momenta_of_a_step():
    o, one = one_step(), np.eye(3)
    force, G = o["Ad0"].T @ o["force"], one + o["back"].T
    close(o["Pi0"], o["Ad0"].T @ o["pi0"])
    apart(o["Pi0"], o["Ad0"] @ o["pi0"])  # (6.18) as printed, without the star
    close(o["Pi0"], o["back"].T @ o["Pi1"] - DT * force)
    middle = (o["Pi0"] + o["Pi1"]) / 2
    close(o["Pi1"] - o["Pi0"], np.linalg.solve(G, 2 * (one - o["back"].T) @ middle + 2 * DT * force))
    axis, nu = o["Theta"], np.array([0.3, -0.7, 0.5])
    close(nu @ axis, np.linalg.solve(G, nu) @ (one + o["back"]) @ axis)
    close(nu @ axis, 2 * np.linalg.solve(G, nu) @ axis)


def test_5_41_needs_the_translation_of_omega_and_the_trivialized_momentum():
    """Hamilton's equations of (5.42) on GL(2): q̇ = qΩ, not Ω; π̇ = −DV(q)qᵀ, but ṗ ≠ −DV(q), as |p| depends on q."""
    q, p, V = np.random.default_rng(3).normal(size=(3, 2, 2))
    m = np.array([[1.0, 2.0], [3.0, 4.0]])  # a diagonal metric

    def hamiltonian(q, p):
        return jnp.sum((q.T @ p) ** 2 / m) / 2 + jnp.sum(jnp.sin(V * q))

    dq, dp = jax.jit(lambda q, p: jax.grad(hamiltonian, (0, 1))(q, p)[::-1])(q, p)
    dp, DV, Omega = -dp, V * np.cos(V * q), q.T @ p / m
    close(dq, q @ Omega)
    apart(dq, Omega)
    close(dp @ q.T + p @ dq.T, -DV @ q.T)
    apart(dp, -DV)


@pytest.mark.paper("5.4: (5.45)–(5.48), Result 12", "momentum on linear groups", "schemes/_group_alpha.py")
@pytest.mark.parametrize("alpha", [0.3, 0.5, 1.0])
def test_result_12_and_5_45_5_48_need_dt(alpha):
    """ℝ³ under rotations, Θ = Δt m⁻¹p_{n+α}: a force along q_{n+1−α} keeps q × p, one along q_{n+α} does not."""
    rng = np.random.default_rng(2)
    q, p, f = rng.normal(size=(3, 3))
    m, xi = np.array([1.0, 2.0, 3.0]), rng.normal(size=3)

    def step(q, p, mass, force):
        p1 = p + DT * force
        return q + DT * (alpha * p1 + (1 - alpha) * p) / mass, p1

    q1, p1 = step(q, p, m, f)
    at, mean = alpha * q + (1 - alpha) * q1, alpha * p1 + (1 - alpha) * p
    change = xi @ (np.cross(q1, p1) - np.cross(q, p))
    assert change == pytest.approx(DT * f @ np.cross(xi, at) + DT * mean @ np.cross(xi, mean / m), abs=1e-14)
    assert abs(change - DT * f @ np.cross(xi, at) - mean @ np.cross(xi, mean / m)) > 1e-3  # as printed
    for weight, kept in ((1 - alpha, True), (alpha, alpha == 0.5)):
        force = np.zeros(3)
        for _ in range(200):  # the force is along a point of the step that it makes
            q1, p1 = step(q, p, 1.0, force)
            force = -((1 - weight) * q + weight * q1)
        assert (np.abs(np.cross(q1, p1) - np.cross(q, p)).max() < 1e-14) == kept
