"""The symmetric heavy top against its closed forms: steady precession, nutation, the sleeping top."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from free_bodies import moving
from grid import examples_of
from repeated import after
from scipy.integrate import quad

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.groups import so3
from lieint_jax.schemes import compose, splitting, top_energy_momentum

A, C, WEIGHT = 5.0, 1.0, 20.0  # of Simo & Wong's top
flow = jax.jit(diagnostics.flow, static_argnums=3)


@jax.jit
def measured(top, state):
    """Γ₃, Ω, Π₃, γ·π, the energy, and the axis in space."""
    Pi, axis = top.body_momentum(state), so3.Ad(state.q, jnp.array([0.0, 0.0, 1.0]))
    return top.Gamma(state)[2], top.angular_velocity(state), Pi[2], top.momentum(state)[0], top.energy(state), axis


def top_of(weight=WEIGHT):
    return li.systems.heavy_top([A, A, C], [0.0, 0.0, weight])


def cubic(top, state):
    """β, b, c and the three roots of u̇² = f(u) = (a − βu)(1 − u²) − (b − cu)², u = Γ₃ = cos θ.

    The first two bound u. Goldstein, Classical Mechanics, 5.7.
    """
    _, _, spin, height, energy, _ = jax.device_get(measured(top, state))
    beta, b, c = 2 * WEIGHT / A, height / A, spin / A
    a = 2 * (energy - spin**2 / (2 * C)) / A
    return beta, b, c, sorted(np.roots([beta, -a - c * c, 2 * b * c - beta, a - b * b]).real)


def test_the_closed_form_of_nutation_and_precession_agrees_with_quadrature():
    """With u = Γ₃ between its two bounds, u̇² = β(u − u₁)(u₂ − u)(u₃ − u) and the precession is (b − cu)/(1 − u²)."""
    top = top_of()
    state = moving(np.array([A, A, C]), [0.5, 0.3, 20.0])
    beta, b, c, (u1, u2, u3) = cubic(top, state)

    def mean(rate):
        """The integral of a rate over a period, from one bound of u to the other and back."""

        def integrand(x):
            u = (u1 + u2) / 2 + (u2 - u1) / 2 * np.sin(x)
            return 2 * rate(u) / np.sqrt(beta * (u3 - u))

        return quad(integrand, -np.pi / 2, np.pi / 2, epsabs=0, epsrel=1e-13)[0]

    period = mean(lambda u: 1.0)
    found = jax.jit(li.systems.lagrange_motion)(top, state)
    assert float(found.nutation_period) == pytest.approx(period, rel=2e-14, abs=0)
    turned = mean(lambda u: (b - c * u) / (1 - u * u))
    assert float(found.precession_rate) == pytest.approx(turned / period, rel=5e-14, abs=0)
    np.testing.assert_allclose(np.cos(found.inclination), [u2, u1], rtol=0, atol=3e-14)


@pytest.mark.long
def test_a_released_top_nutates_with_the_closed_form_s_period_and_amplitude():
    """Released with nothing but spin, the axis falls to the other root in half a period and is back after a whole."""
    top, state = jax.jit(lambda: examples_of("heavy_top")["lagrange"][:2])()
    beta, _, _, (low, high, u3) = cubic(top, state)
    period = 4 * float(mpmath.ellipk((high - low) / (u3 - low))) / np.sqrt(beta * (u3 - low))
    u0 = float(measured(top, state)[0])
    assert u0 == pytest.approx(high, abs=1e-13)
    assert low < high - 5e-3
    end = flow(top, state, period / 2, 200)
    assert float(measured(top, end)[0]) == pytest.approx(low, abs=2e-13)
    for step, order in ((top_energy_momentum(top), 2), (splitting(top), 2), (compose(splitting(top), 4), 4)):
        errors = []
        for n in (40, 80):
            u, Omega, *_ = jax.device_get(measured(top, after(step, state, period / n, n)[0]))
            errors.append(abs(u - u0) + np.abs(Omega[:2]).max())
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)
        assert errors[1] < 0.05


@pytest.mark.long
@pytest.mark.parametrize("fast", [False, True])
def test_steady_precession_is_possible_at_both_rates(fast):
    """A cos θ Ω² − CΩ₃ Ω + Mgl = 0: the axis keeps its tilt and turns at Ω, for both roots, to O(Δt²)."""
    top, tilt, spin = top_of(), 0.7, 30.0
    rates = np.sort(np.roots([A * np.cos(tilt), -C * spin, WEIGHT]).real)
    rate = rates[1] if fast else rates[0]
    t = 2.0

    @jax.jit
    def motion(rate):
        """The state that precesses at a rate, and its axis at t."""
        q, up = so3.exp(jnp.array([tilt, 0.0, 0.0])), jnp.array([0.0, 0.0, 1.0])
        Omega = rate * so3.Ad_star(q, up)
        turn = so3.multiply(so3.exp(rate * t * up), q)
        return top.state(q, angular_velocity=Omega.at[2].set(spin)), so3.Ad(turn, up)

    state, axis = motion(rate)
    end = flow(top, state, t, 200)
    assert np.abs(measured(top, end)[-1] - np.asarray(axis)).max() < 2e-12
    for step in (top_energy_momentum(top), splitting(top)):
        errors = []
        for n in (200, 400):
            errors.append(np.abs(measured(top, after(step, state, t / n, n)[0])[-1] - np.asarray(axis)).max())
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


@pytest.mark.long
def test_the_sleeping_top_wakes_below_the_threshold():
    """Upright it is stable if and only if (CΩ₃)² > 4 A Mgl; below, the tilt grows as exp(√(Mgl/A − (CΩ₃/2A)²) t)."""
    top = top_of()

    @jax.jit
    def axes(step, spin):
        """The axis of a top that starts almost upright, every 400th step of 4800."""
        state = top.state(so3.exp(jnp.array([1e-7, 0.0, 0.0])), angular_velocity=jnp.array([0.0, 0.0, 1.0]) * spin)
        path = li.integrate(step, state, 0.0025, 4800, save_every=400).state
        return jax.vmap(so3.Ad, (0, None))(path.q, jnp.array([0.0, 0.0, 1.0]))

    threshold = np.sqrt(4 * A * WEIGHT) / C
    for step in (top_energy_momentum(top), splitting(top)):
        for factor in (0.9, 1.1):
            spin = factor * threshold
            axis = np.asarray(axes(step, spin))
            tilt = np.hypot(axis[:, 0], axis[:, 1])
            if factor > 1:
                assert tilt.max() < 1e-6
            else:
                growth = np.sqrt(WEIGHT / A - (C * spin / (2 * A)) ** 2)
                assert np.log(tilt[12] / tilt[8]) / 4 == pytest.approx(growth, rel=0.003)


TOPS = [  # weight, axis, angular velocity; the third passes 0.9° from hanging, the fourth swings through a loop
    (20.0, [0.0, 0.0, 1.0], [0.0, 0.0, 50.0]),
    (20.0, [0.0, 0.6, 0.8], [1.0, 0.5, 4.0]),
    (-3.0, [0.0, 0.0, 2.0], [1.0, 0.5, 4.0]),
    (20.0, [0.0, 0.0, 1.0], [3.0, 0.0, 8.0]),
]


@jax.jit
def facts(top, Omega):
    """Of a top with an angular velocity: its motion in closed form, γ·π, Π, energy, and e₃ in space now and after a
    period of nutation of the exact flow."""
    state = top.state(so3.exp(jnp.array([0.8, 0.1, 0.0])), angular_velocity=Omega)
    found = li.systems.lagrange_motion(top, state)
    after = diagnostics.flow(top, state, found.nutation_period, 200)
    east = [so3.Ad(z.q, jnp.array([0.0, 0.0, 1.0])) for z in (state, after)]
    return found, top.momentum(state)[0], top.body_momentum(state), top.energy(state), east


@pytest.mark.long
@pytest.mark.parametrize("case", TOPS, ids=["fast", "tilted", "hanging", "looping"])
def test_lagrange_s_top_agrees_with_quadrature_in_30_digits_and_with_the_flow(case):
    """Floors: period 3e-16, precession 3e-13 (roots close together), recurrence 2e-15."""
    weight, axis, Omega = case
    top = li.systems.heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, weight], axis)
    found, momentum, Pi, energy, east = jax.device_get(facts(top, np.array(Omega)))
    with mpmath.workdps(30):

        def number(x):
            return mpmath.mpf(float(x))

        size, Pi = number(np.linalg.norm(axis)), [number(x) for x in Pi]
        sign = int(np.sign(weight))
        alpha, a = abs(weight) * size * 2 / 5, (2 * number(energy) - Pi[2] ** 2) / 5
        b, c = number(momentum) / size / 5, sign * Pi[2] / 5
        guesses = np.sort(np.roots([float(x) for x in (alpha, -(a + c * c), 2 * b * c - alpha, a - b * b)]).real)
        speed = lambda u: (a - alpha * u) * (1 - u * u) - (b - c * u) ** 2  # noqa: E731
        u1, u2, u3 = (mpmath.findroot(speed, guess) for guess in guesses)

        def integral(f):
            def integrand(s):
                u = u1 + (u2 - u1) * mpmath.sin(s) ** 2
                return 4 * f(u) / mpmath.sqrt(alpha * (u3 - u))

            return mpmath.quad(integrand, mpmath.linspace(0, mpmath.pi / 2, 9))

        period, turned = integral(lambda u: 1), integral(lambda u: (b - c * u) / (1 - u * u))
        assert abs(number(found.nutation_period) / period - 1) < 3e-15
        assert abs(number(found.precession_rate) * period / turned - 1) < 3e-12
        np.testing.assert_allclose(np.cos(found.inclination), [float(u2), float(u1)], rtol=0, atol=1e-13)
    gamma = np.array(axis) / np.linalg.norm(axis)
    east, turn = sign * np.array(east), float(found.precession_rate * found.nutation_period)
    cosine = east @ gamma
    assert abs(cosine[1] - cosine[0]) < 2e-14
    across = np.linalg.svd(gamma[None])[2][1:]
    across[1] *= np.sign(np.linalg.det([*across, gamma]))
    angle = np.diff([np.arctan2(*(across @ x)[::-1]) for x in east])[0]
    assert abs((angle - turn + np.pi) % (2 * np.pi) - np.pi) < 3e-12
