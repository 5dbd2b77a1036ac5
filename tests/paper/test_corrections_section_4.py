"""Every row of the corrections to Section 4: the right form holds, and the printed one does not.

Floors observed are in the comments; bounds are a few times that.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest
from paper import KAPPAS, ONE, H, cay, close, hat, omega_inverse, rot, skew

import lieint_jax as li
from lieint_jax.core.tangent import value_and_jacobian
from lieint_jax.groups import so3

DT = 0.3
E, GAMMA = np.array([0.4, -0.7, 0.9]), np.array([0.3, 0.5, 0.8])


def force(kappa, bar, Q):
    """e of (4.6) with its factor κ, as a function of Θ̄ and Λ_n."""
    return kappa(bar @ bar) * Q @ (ONE + so3.to_matrix(so3.cayley(kappa(bar @ bar) * bar))) @ E / 2


ATTITUDE = np.array([0.3, 0.8, -0.4, 0.5]) / np.sqrt(1.14)


@jax.jit
def _step(step):
    """A step of DT, its report and linearization, both attitudes; the derivatives of `force` in a turn and in Θ̄."""
    state = step.system.state(ATTITUDE, angular_velocity=[0.7, -0.4, 0.5])
    after, info, L = value_and_jacobian(step.system.phase_space, lambda z: step(z, DT), state)
    Q = [so3.to_matrix(z.q) for z in (state, after)]
    bar = DT / 2 * sum(step.system.angular_velocity(z) for z in (state, after))
    slopes = jax.jacfwd(
        lambda theta, bar: force(step.kappa, bar, so3.to_matrix(so3.exp(theta)) @ Q[0]), argnums=(0, 1)
    )(jnp.zeros(3), bar)
    return (state.p, after.p), info, L, Q, slopes


class OneStep:
    """A step of each κ of a heavy top in general position, in the paper's letters; J full, γ of any length."""

    def __init__(self, name):
        turn = paper.exp(np.array([0.4, -0.2, 0.7]))
        self.J = turn @ np.diag([1.0, 2.0, 3.0]) @ turn.T
        top = li.systems.heavy_top(self.J, E, GAMMA)
        kappa = getattr(li.maps, f"kappa_{name}")
        step = li.schemes.top_energy_momentum(top, kappa, iterations=5)
        (self.pi0, self.pi1), info, self.L, (self.Q0, self.Q1), slopes = jax.device_get(_step(step))
        assert info.converged
        self.name = name
        self.Pi0, self.Pi1 = self.Q0.T @ self.pi0, self.Q1.T @ self.pi1
        self.bar = DT * np.linalg.inv(self.J) @ (self.Pi0 + self.Pi1) / 2  # Θ̄ (4.4)
        self.kappa = KAPPAS[name][0](self.bar @ self.bar)
        self.T, self.H = cay(self.kappa * self.bar), H(name, self.bar)
        self.e = self.kappa * (self.Q0 + self.Q1) @ E / 2
        self.dV = GAMMA @ (self.Q1 - self.Q0) @ E
        self.g = self.Q0.T @ np.cross(GAMMA, self.e)
        by_turn, by_bar = slopes
        self.F, self.G = hat(GAMMA) @ by_turn, hat(GAMMA) @ by_bar  # (4.19)


one_step = functools.cache(OneStep)


@pytest.fixture(params=[pytest.param(x, marks=[pytest.mark.long] * (x != "symplectic")) for x in KAPPAS])
def s(request):
    return one_step(request.param)


@pytest.mark.paper("4: (4.1), (4.2)", "tops", "systems/_potential_top.py")
def test_4_1_and_4_2_the_torque_is_gamma_cross_e():
    """Against the derivative of V along δθ̂Λ; the other sign is wrong by the whole torque."""
    top = li.systems.potential_top([1.0, 2.0, 3.0], lambda G: jnp.sin(2 * G[0]) + G[1] ** 3 - G[0] * G[2], GAMMA)

    @jax.jit
    def all_of_them(q):
        slope = jax.grad(lambda theta: top.potential_energy(so3.multiply(so3.exp(theta), q)))(jnp.zeros(3))
        Q = so3.to_matrix(q)
        return slope, Q @ jax.grad(top.potential)(Q.T @ GAMMA), top.force(q)

    slope, e, torque = jax.device_get(all_of_them(ATTITUDE))
    assert close(np.cross(GAMMA, e), -slope) < 1e-15
    assert close(torque, -slope) < 1e-15
    assert close(np.cross(GAMMA, e), slope) > 0.1


def test_4_the_potential_is_invariant_under_left_rotations_about_gamma():
    """V(Λ) = Ṽ(Λᵀγ) is V(QΛ) for every Q with Qγ = γ. Under the right action, V(ΛQ), it changes."""
    top = li.systems.heavy_top([1.0, 2.0, 3.0], E, GAMMA)

    @jax.jit
    def energies(q):
        turn = so3.exp(top.axis)
        return [top.potential_energy(z) for z in (q, so3.multiply(turn, q), so3.multiply(q, turn))]

    V, left, right = map(float, energies(ATTITUDE))
    assert left == pytest.approx(V, abs=1e-15)
    assert abs(right - V) > 0.1


def test_5_44_is_for_the_algebra_of_the_symmetry_group(s):
    """The momentum about γ needs a force normal to γ, which spans the algebra of G̃; normal to all η it would be 0."""
    force = (s.pi1 - s.pi0) / DT
    assert abs(GAMMA @ force) < 1e-15  # floor 2e-16
    assert np.abs(force).max() > 0.1


@pytest.mark.long
def test_4_3_and_4_4_hold_for_the_step(s):
    assert close(s.Q1, s.Q0 @ s.T) < 2e-15
    assert close(s.pi1, s.pi0 + DT * np.cross(GAMMA, s.e)) < 1e-15
    assert GAMMA @ (s.pi1 - s.pi0) == pytest.approx(0, abs=3e-16)  # Result 6


@pytest.mark.long
def test_4_5_and_4_10_have_no_kappa(s):
    work = GAMMA @ np.cross(s.Q0 @ s.bar, s.e)
    assert work == pytest.approx(s.dV, abs=2e-15)
    if s.name != "cayley":
        assert abs(s.kappa * work - s.dV) > 1e-4


def test_4_6_holds_only_with_the_factor_kappa(s):
    """As printed, e lacks the factor κ, and (4.5) fails for every κ but 1."""
    work = GAMMA @ np.cross(s.Q0 @ s.bar, s.e / s.kappa)
    assert (abs(work - s.dV) > 1e-4) == (s.name != "cayley")


def test_4_7_is_with_t_not_its_transpose(s):
    assert close(s.Pi0, s.T @ s.Pi1 - DT * s.g) < 5e-15
    assert close(s.Pi0, s.T.T @ s.Pi1 - DT * s.g) > 0.1


def test_4_9_holds_and_4_8_holds_with_corrected_signs(s):
    assert close(np.linalg.inv(ONE + s.T) @ (s.T - ONE), s.kappa * hat(s.bar) / 2) < 1e-15  # (4.9)
    free = -s.kappa / DT * np.cross(s.bar, s.J @ s.bar)
    assert close(s.Pi1 - s.Pi0, free + DT * (ONE - s.kappa * hat(s.bar) / 2) @ s.g) < 5e-15
    printed = DT * s.kappa * (-free / s.kappa / DT + (ONE + s.kappa * hat(s.bar) / 2) @ s.g)
    assert close(s.Pi1 - s.Pi0, printed) > 0.02


def test_4_11_and_4_12_hold(s):
    assert pytest.approx(s.dV, abs=1e-15) == GAMMA @ s.Q0 @ (s.T - ONE) @ E


def blocks(s):
    """A_n, A_{n+1}, B_n, B_{n+1} of (4.18)."""
    Ji = np.linalg.inv(s.J)
    A0, A1 = DT**2 / 2 * s.G @ Ji @ s.Q0.T, -(DT**2) / 2 * s.G @ Ji @ s.Q1.T
    B0, B1 = DT / 2 * s.Q1 @ s.H @ Ji @ s.Q0.T, -DT / 2 * s.Q1 @ s.H @ Ji @ s.Q1.T
    return A0, A1, B0, B1


def tildes(s):
    """L̃_n and L̃_{n+1} of (4.16) and (4.17)."""
    A0, A1, B0, B1 = blocks(s)
    L0 = np.block([[ONE + B0 @ hat(s.pi0), B0], [A0 @ hat(s.pi0) + DT * s.F, ONE + A0]])
    L1 = np.block([[ONE + B1 @ hat(s.pi1), B1], [A1 @ hat(s.pi1), ONE + A1]])
    return L0, L1


def test_4_15_to_4_19_are_the_linearized_step(s):
    L0, L1 = tildes(s)
    assert close(np.linalg.solve(L1, L0), s.L) < 1e-14  # floor 2e-15


def test_4_20_is_the_test_for_symplecticity_and_its_three_conditions(s):
    """The difference of both sides, block by block; it is not zero, as energy is conserved (Result 8)."""
    (A0, A1, B0, B1), (L0, L1) = blocks(s), tildes(s)
    p0, p1 = hat(s.pi0), hat(s.pi1)
    gap = L1 @ omega_inverse(s.pi1) @ L1.T - L0 @ omega_inverse(s.pi0) @ L0.T
    one = 2 * skew(B1 - B0) - (B1 @ p1 @ B1.T - B0 @ p0 @ B0.T)
    two = DT * s.F @ B0.T - (A1 @ (p1 @ B1.T - ONE) - A0 @ (p0 @ B0.T - ONE))
    three = DT * (hat(np.cross(GAMMA, s.e)) + 2 * skew(s.F @ (ONE + A0).T)) - (A1 @ p1 @ A1.T - A0 @ p0 @ A0.T)
    assert close(gap, np.block([[one, -two.T], [two, three]])) < 5e-15
    assert np.abs(gap).max() > 1e-3


def test_4_21_is_the_second_condition_given_the_first(s):
    A0, A1, B0, B1 = blocks(s)
    p0, p1 = hat(s.pi0), hat(s.pi1)
    two = DT * s.F @ B0.T - (A1 @ (p1 @ B1.T - ONE) - A0 @ (p0 @ B0.T - ONE))
    one = 2 * skew(B1 - B0) - (B1 @ p1 @ B1.T - B0 @ p0 @ B0.T)
    G_Hinv = s.G @ np.linalg.inv(s.H)
    right = (s.F @ s.Q0 - G_Hinv @ (s.T + ONE).T) @ np.linalg.inv(s.J) @ s.H.T @ s.Q1.T * DT**2 / 2
    assert close(two, right + DT * G_Hinv @ s.Q1.T @ one) < 5e-15


def test_4_22_and_4_14_the_skew_part_of_f(s):
    """(4.22) says rot F = −½γ×e. So F = ½(e×γ)^ + S for a symmetric S; the printed ½êγ̂ has half of it."""
    torque = np.cross(GAMMA, s.e)
    S = np.array([[1.0, 0.2, -0.3], [0.2, 2.0, 0.5], [-0.3, 0.5, 0.7]])
    assert close(torque + 2 * rot(hat(np.cross(s.e, GAMMA)) / 2 + S), 0) < 1e-15
    assert close(torque + 2 * rot(hat(s.e) @ hat(GAMMA) / 2 + S), torque / 2) < 1e-15
    assert np.abs(torque).max() > 0.1
    assert close(np.linalg.inv(ONE + s.T).T, (ONE + s.kappa * hat(s.bar) / 2) / 2) < 1e-15  # (4.21) solved for G


def test_4_13_symplectic_within_the_class_forces_zero_force():
    """(3.5) is Π_n − Π_{n+1} = (κ/Δt) Θ̄ × JΘ̄; by (4.8) what is left is Δt(1 − ½κΘ̄^)g, zero only if g = 0."""
    s = one_step("symplectic")
    left = 4 / DT * skew((s.T + ONE) @ np.linalg.inv(s.H).T @ s.J)
    rest = DT * (ONE - s.kappa * hat(s.bar) / 2) @ s.g
    assert close(left, hat(s.Pi0 - s.Pi1 + rest)) < 2e-14  # floor 4e-15
    assert np.abs(rest).max() > 0.05
    assert np.linalg.det(ONE - s.kappa * hat(s.bar) / 2) >= 1
    assert close(s.Pi1 - s.Pi0 - rest, -s.kappa / DT * np.cross(s.bar, s.J @ s.bar)) < 5e-15  # (4.13), corrected
    assert close(s.Pi1 - s.Pi0 - rest, np.cross(s.bar, s.J @ s.bar) / DT) > 0.1  # as printed


def test_the_kappas_of_the_paper_are_those_of_the_package():
    ours = jax.jit(lambda x: [getattr(li.maps, f"kappa_{name}")(x) for name in KAPPAS])(0.3)
    assert list(map(float, ours)) == pytest.approx([kappa(0.3) for kappa, _ in KAPPAS.values()], rel=1e-15, abs=0)
