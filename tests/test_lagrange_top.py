"""The symmetric heavy top against its closed forms: steady precession, nutation, the sleeping top."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.groups import so3
from lieint_jax.schemes import compose, splitting, top_energy_momentum
from lieint_jax.systems.heavy_top import lagrange

A, C, WEIGHT = 5.0, 1.0, 20.0  # of Simo & Wong's top
run = jax.jit(li.integrate, static_argnums=(3, 4))


def top_of(weight=WEIGHT):
    return li.systems.heavy_top([A, A, C], [0.0, 0.0, weight])


def nutation(top, state):
    """The two roots that bound u = Γ₃ = cos θ, and the period of u, 4K/√(β(u₃ − u₁)).

    u̇² = f(u) = (a − βu)(1 − u²) − (b − cu)², a cubic: Goldstein, Classical Mechanics, 5.7.
    """
    spin, height = float(top.body_momentum(state)[2]), float(top.momentum(state)[0])
    beta = 2 * WEIGHT / A
    a = 2 * (float(top.energy(state)) - spin**2 / (2 * C)) / A
    b, c = height / A, spin / A
    roots = sorted(np.roots([beta, -a - c * c, 2 * b * c - beta, a - b * b]).real)
    k2 = (roots[1] - roots[0]) / (roots[2] - roots[0])
    return roots[0], roots[1], 4 * float(mpmath.ellipk(k2)) / np.sqrt(beta * (roots[2] - roots[0]))


def test_nutation_period_and_amplitude():
    """Released with nothing but spin, the axis falls to the other root in half a period and is back after a whole."""
    top, state = lagrange()
    low, high, period = nutation(top, state)
    u0 = float(top.Gamma(state)[2])
    assert u0 == pytest.approx(high, abs=1e-13)
    assert low < high - 5e-3
    end = diagnostics.flow(top, state, period / 2, 100)
    assert float(top.Gamma(end)[2]) == pytest.approx(low, abs=2e-13)
    for step, order in ((top_energy_momentum(top), 2), (splitting(top), 2), (compose(splitting(top), 4), 4)):
        errors = []
        for n in (40, 80):
            z = jax.tree.map(lambda x: x[-1], run(step, state, period / n, n, n).state)
            errors.append(abs(float(top.Gamma(z)[2]) - u0) + float(jnp.abs(top.angular_velocity(z)[:2]).max()))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)
        assert errors[1] < 0.05


@pytest.mark.parametrize("fast", [False, True])
def test_steady_precession_at_both_rates(fast):
    """A cos θ Ω² − CΩ₃ Ω + Mgl = 0: the axis keeps its tilt and turns at Ω, for both roots, to O(Δt²)."""
    top, tilt, spin = top_of(), 0.7, 30.0
    rates = np.sort(np.roots([A * np.cos(tilt), -C * spin, WEIGHT]).real)
    rate = rates[1] if fast else rates[0]
    q = so3.exp(jnp.array([tilt, 0.0, 0.0]))
    Omega = rate * so3.Ad_star(q, jnp.array([0.0, 0.0, 1.0]))
    state = top.state(q, angular_velocity=Omega.at[2].set(spin))
    t = 2.0
    turn = so3.multiply(so3.exp(jnp.array([0, 0, rate * t])), q)
    axis = so3.Ad(turn, jnp.array([0.0, 0.0, 1.0]))
    end = diagnostics.flow(top, state, t, 200)
    assert np.abs(so3.Ad(end.q, jnp.array([0.0, 0.0, 1.0])) - axis).max() < 2e-12
    for step in (top_energy_momentum(top), splitting(top)):
        errors = []
        for n in (200, 400):
            z = run(step, state, t / n, n, n).state
            errors.append(np.abs(so3.Ad(z.q[-1], jnp.array([0.0, 0.0, 1.0])) - axis).max())
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


def test_the_sleeping_top_wakes_below_the_threshold():
    """Upright it is stable if and only if (CΩ₃)² > 4 A Mgl; below, the tilt grows as exp(√(Mgl/A − (CΩ₃/2A)²) t)."""
    top = top_of()
    threshold = np.sqrt(4 * A * WEIGHT) / C
    for step in (top_energy_momentum(top), splitting(top)):
        for factor in (0.9, 1.1):
            spin = factor * threshold
            state = top.state(so3.exp(jnp.array([1e-7, 0.0, 0.0])), angular_velocity=[0.0, 0.0, spin])
            trajectory = run(step, state, 0.0025, 4800, 400)
            axis = jax.vmap(so3.Ad, (0, None))(trajectory.state.q, jnp.array([0.0, 0.0, 1.0]))
            tilt = np.hypot(axis[:, 0], axis[:, 1])
            if factor > 1:
                assert tilt.max() < 1e-6
            else:
                growth = np.sqrt(WEIGHT / A - (C * spin / (2 * A)) ** 2)
                assert np.log(tilt[12] / tilt[8]) / 4 == pytest.approx(growth, rel=0.003)
