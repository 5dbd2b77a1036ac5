"""The class of Result 14 with velocity at n+α and force at n+1−α: what it keeps for every α, and what for ½ alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slopes

import lieint_jax as li
from lieint_jax import groups, maps
from lieint_jax.diagnostics import linearization, order

pytestmark = pytest.mark.long

QUICK = {"xla_llvm_disable_expensive_passes": True}
SYMPLECTIC = maps.scaled_cayley(maps.kappa_symplectic)
LINE = groups.translations(2)


def well(q):
    """A potential of ℝ² that is invariant under turns about 0 but for its last term."""
    x, y = q[0, 2], q[1, 2]
    return -1 / jnp.sqrt(1 + x * x + y * y) + 0.1 * x**3


def leaning(q):
    """A potential of SO(3) that is invariant under turns about the vertical."""
    height = 1 - 2 * (q[1] * q[1] + q[2] * q[2])
    return 0.6 * height + 0.2 * height**3


FREE = li.systems.euler(groups.so3, [1.0, 2.0, 3.0])
TOP = li.systems.group_potential(groups.so3, [1.0, 2.0, 3.0], leaning, [[0.0, 0.0, 1.0]])
PLANE = li.systems.group_potential(LINE, [[1.0, 0.3], [0.3, 2.0]], well)
SPIN = FREE.state([0.8, 0.6, 0, 0], velocity=[0.5, -0.4, 0.6])
MOVING = PLANE.state(np.array([[1, 0, 0.8], [0, 1, -0.3], [0, 0, 1.0]]), velocity=[0.3, 0.5])


@functools.partial(jax.jit, compiler_options=QUICK)
def measured(step, state, dt):
    """The end of a step, its flag, its symplectic defect, the changes of energy and momentum, and the way back."""
    system, omega = step.system, step.system.phase_space.omega
    after, info = step(state, dt)
    L = linearization(step, state, dt)
    defect = jnp.max(jnp.abs(L.T @ omega(after) @ L - omega(state)))
    change = [jnp.max(jnp.abs(f(after) - f(state)), initial=0) for f in (system.energy, system.momentum)]
    return after, info.converged, defect, *change


@pytest.mark.parametrize("alpha", [0.3, 0.0, 1.0])
def test_without_a_potential_momentum_alone_is_conserved_for_every_alpha(alpha):
    """Energy and form are lost as Δt² per step, even by the map that keeps both at α = ½; order 1."""
    step = li.schemes.group_alpha(FREE, alpha, SYMPLECTIC)
    (_, good, *coarse), (_, _, *fine) = (measured(step, SPIN, dt) for dt in (0.2, 0.1))
    assert good
    assert coarse[2] == 0  # π bit for bit
    for k in (0, 1):
        assert coarse[k] > 1e-3
        assert np.log2(coarse[k] / fine[k]) == pytest.approx(2, abs=0.1)
    assert order(step, SPIN, 0.05) == pytest.approx(1, abs=0.05)


@pytest.mark.quick
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_the_ends_of_the_family_are_the_symplectic_euler_schemes(alpha):
    """On ℝ²: the velocity is that before the step and the force that after it, or the other way round."""
    after, converged, *_ = measured(li.schemes.group_alpha(PLANE, alpha), MOVING, 0.3)
    x0, x1 = (np.asarray(z.q)[:2, 2] for z in (MOVING, after))
    p0, p1 = (np.asarray(z.p) for z in (MOVING, after))
    r = [x0, x1][alpha == 0]
    force = -r / (1 + r @ r) ** 1.5 - [0.3 * r[0] ** 2, 0]
    assert converged
    np.testing.assert_allclose(x1 - x0, 0.3 * np.linalg.solve(PLANE.metric, [p0, p1][alpha == 1]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(p1 - p0, 0.3 * force, rtol=0, atol=1e-15)


def test_without_a_potential_alpha_one_half_is_group_midpoint():
    step = li.schemes.group_alpha(FREE, 0.5, SYMPLECTIC)
    other = measured(li.schemes.group_midpoint(FREE, SYMPLECTIC), SPIN, 0.3)
    after, good, defect, energy, momentum = measured(step, SPIN, 0.3)
    assert good
    np.testing.assert_allclose(after.q, other[0].q, rtol=0, atol=1e-15)
    assert max(defect, energy, momentum) < 4e-15
    assert measured(li.schemes.group_alpha(FREE), SPIN, 0.3)[2] > 1e-4  # exp is not symplectic here


@pytest.mark.paper("1.1: (1.1), (1.2)", "canonical systems, on translations of ℝⁿ", "schemes/_group_alpha.py")
@pytest.mark.parametrize("alpha", [0.3, 0.0, 0.5, 1.0])
def test_on_an_abelian_group_the_form_is_conserved_for_every_alpha(alpha):
    """1″ to 3″ of Result 14 hold; energy is not kept; order 2 for ½ alone."""
    step = li.schemes.group_alpha(PLANE, alpha)
    _, good, defect, energy, _ = measured(step, MOVING, 0.4)
    assert good
    assert defect < 4e-15  # floor 5e-16
    assert energy > 1e-6
    assert order(step, MOVING, 0.1) == pytest.approx(1 + (alpha == 0.5), abs=0.06)


@pytest.mark.parametrize("alpha", [0.3, 0.5])
def test_the_equations_5_43_and_5_45_hold_as_they_stand(alpha):
    """q₁ = q₀ + Δt m⁻¹p_{n+α}, p₁ = p₀ − Δt∇V(q_{n+1−α}), by numpy; with p_{n+1−α} in the first they do not."""
    dt, m = 0.4, np.asarray(PLANE.metric)
    after = measured(li.schemes.group_alpha(PLANE, alpha), MOVING, dt)[0]
    (q0, q1), (p0, p1) = ([np.asarray(z.q)[:2, 2] for z in (MOVING, after)], [np.asarray(z.p) for z in (MOVING, after)])
    x, y = alpha * q0 + (1 - alpha) * q1
    slope = np.array([x, y]) / (1 + x * x + y * y) ** 1.5 + np.array([0.3 * x * x, 0])
    np.testing.assert_allclose(q1 - q0, dt * np.linalg.solve(m, (1 - alpha) * p0 + alpha * p1), rtol=0, atol=4e-16)
    np.testing.assert_allclose(p1 - p0, -dt * slope, rtol=0, atol=4e-16)
    exchanged = np.abs(q1 - q0 - dt * np.linalg.solve(m, alpha * p0 + (1 - alpha) * p1)).max()
    assert alpha == 0.5 or exchanged > 1e-3


@pytest.mark.paper("5.4: (5.43), (5.44)", "the class, and momentum", "schemes/_group_alpha.py")
@pytest.mark.parametrize("alpha", [0.5, 0.3])
def test_with_a_potential_the_momentum_of_its_symmetry_is_conserved_and_the_form_is_not(alpha):
    """(5.44) for every α; Result 8: on SO(3) no member is symplectic, the best loses the form as Δt³."""
    step = li.schemes.group_alpha(TOP, alpha)
    (_, good, *coarse), (_, _, *fine) = (measured(step, SPIN, dt) for dt in (0.2, 0.1))
    assert good
    assert coarse[2] < 2e-15
    rate = 3 if alpha == 0.5 else 2
    assert coarse[0] > 1e-5
    assert np.log2(coarse[0] / fine[0]) == pytest.approx(rate, abs=0.2)
    assert coarse[1] > 1e-7
    assert order(step, SPIN, 0.05) == pytest.approx(step.order, abs=0.05)


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize(("system", "state"), [(PLANE, MOVING), (FREE, SPIN), (TOP, SPIN)], ids=["V", "free", "top"])
def test_alpha_is_undone_by_one_less_alpha(system, state):
    forth, back = (li.schemes.group_alpha(system, alpha) for alpha in (0.2, 0.8))
    there = measured(forth, state, 0.3)[0]
    for kept, lost, at_first in zip(
        measured(back, there, -0.3)[0][:2], measured(forth, there, -0.3)[0][:2], state[:2], strict=True
    ):
        np.testing.assert_allclose(kept, at_first, rtol=0, atol=4e-15)
        assert system is FREE or np.abs(lost - at_first).max() > 1e-3


def test_any_group_and_derivatives_by_alpha_dt_and_the_metric():
    """On SL(2) with a potential."""
    system = li.systems.group_potential(groups.special_linear(2), [1.0, 2.0, 3.0], lambda q: 0.2 * jnp.sum(q * q))
    state = li.State(jnp.eye(2), jnp.array([0.5, -0.8, 1.8]))
    slopes.assert_agree(li.schemes.group_alpha(system, 0.4), state, 0.2)
