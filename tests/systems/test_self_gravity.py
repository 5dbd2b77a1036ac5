"""The gravity of an ellipsoid on itself: its energy, its stress, and the figures of a rotating liquid."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import elliprf

import lieint_jax as li
from lieint_jax._numerics import vectors

W = li.systems.self_gravity(1.0, 1.0, 1.0)
BALL = li.systems.incompressible_body(np.full(3, 0.2), W)


def rotated(c, angles):
    """A symmetric matrix with the eigenvalues c."""
    R = np.asarray(li.groups.so3.to_matrix(li.groups.so3.exp(jnp.asarray(angles))))
    return R @ np.diag(c) @ R.T


ANGLES = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@pytest.mark.long
@given(st.lists(st.floats(0.1, 4.0), min_size=3, max_size=3), ANGLES)
def test_the_energy_is_carlsons_integral(c, angles):
    assert float(energy(rotated(c, angles))) == pytest.approx(-0.6 * elliprf(*c), rel=5e-13, abs=0)  # observed 2e-13


energy = jax.jit(W)
stress = jax.jit(lambda C: W.stress(vectors.symmetric(C)).rows.array)
gradient = jax.jit(jax.grad(W))


@jax.jit
def mean_work(C, D):
    """½ S̄:D."""
    D = vectors.symmetric(D)
    return W.mean_stress(vectors.symmetric(C), D).inner(D) / 2


@pytest.mark.long
@given(st.lists(st.floats(0.1, 4.0), min_size=3, max_size=3), ANGLES)
def test_the_stress_is_twice_the_gradient(c, angles):
    C = jnp.asarray(rotated(c, angles))
    slope = gradient(C)
    np.testing.assert_allclose(stress(C), slope + slope.T, rtol=0, atol=1e-12 * float(abs(slope).max()))


@pytest.mark.long
@given(st.lists(st.floats(0.3, 3.0), min_size=3, max_size=3), ANGLES, st.floats(1e-9, 0.2))
def test_the_mean_stress_does_the_work_of_the_energy(c, angles, size):
    C = rotated(c, angles)
    D = size * rotated([0.3, -0.5, 1.0], angles[::-1])
    change = float(energy(C + D)) - float(energy(C))
    assert float(mean_work(C, D)) == pytest.approx(change, rel=1e-11, abs=5e-16)


def spheroid(e):
    """F of Maclaurin's spheroid of eccentricity e and its angular velocity, G = M = R = 1."""
    a = (1 - e * e) ** (-1 / 6)
    square = 0.75 * (2 * np.sqrt(1 - e * e) / e**3 * (3 - 2 * e * e) * np.arcsin(e) - 6 * (1 - e * e) / e**2)
    return np.diag([a, a, a * np.sqrt(1 - e * e)]), np.sqrt(square)


@pytest.mark.long
@pytest.mark.parametrize("e", [0.1, 0.5, 0.812670, 0.95])
def test_maclaurins_spheroids_rotate_rigidly(e):
    """The acceleration of a rigid rotation is −Ω² of the horizontal part; the floor is 4e-16."""
    F, Omega = spheroid(e)
    state = BALL.state(F, angular_velocity=[0.0, 0.0, Omega])
    force = np.asarray(BALL.vector_field(state).p)
    expected = -(Omega**2) * np.diag([1.0, 1.0, 0.0]) @ F * 0.2
    np.testing.assert_allclose(force, expected, rtol=0, atol=5e-15)


def test_the_largest_angular_velocity_is_at_the_published_eccentricity():
    e = np.linspace(0.92, 0.94, 20001)
    square = np.array([spheroid(x)[1] ** 2 for x in e])
    assert e[square.argmax()] == pytest.approx(0.929956, abs=1e-6)
    assert square.max() * 4 / 3 == pytest.approx(0.449331, abs=1e-6)  # over πGρ = 3/4


@pytest.mark.parametrize("e", [1e-4, 0.01, 0.3, 0.7, 0.72, 0.9])
def test_a_spheroid_and_its_modes_are_right_to_round_off(e):
    """Chandrasekhar's formulas, §§ 32 and 33, in 50 digits; observed: 1e-15. Near a ball their terms cancel."""
    with mpmath.workdps(50):
        x = mpmath.mpf(e)
        q = mpmath.sqrt(1 - x * x)
        angle = mpmath.asin(x)
        Omega = mpmath.sqrt(0.75 * (2 * q / x**3 * (3 - 2 * x * x) * angle - 6 * q * q / x**2))
        A1, A3 = q / x**3 * angle - q * q / x**2, 2 / x**2 - 2 * q / x**3 * angle
        root = mpmath.sqrt(3 * (A1 - (2 - (A1 - A3) / (q * q - 1)) / 4) - Omega**2)
        wanted = [complex(Omega), complex(Omega + root), complex(Omega - root)]
    found = [li.systems.maclaurin_spheroid(e).angular_velocity, *li.systems.maclaurin_modes(e)]
    np.testing.assert_allclose(found, wanted, rtol=8e-15)


@pytest.mark.parametrize("e", [0.2, 0.7, 0.97])
def test_the_modes_of_a_spheroid_are_chandrasekhar_s_integral(e):
    """σ = Ω ± √(3B₁₁ − Ω²) for G = M = R = 1, B₁₁ by quadrature."""
    a, Omega = li.systems.maclaurin_spheroid(e)
    c = a * np.sqrt(1 - e * e)
    B11 = a * a * c * quad(lambda u: u / ((a * a + u) ** 3 * np.sqrt(c * c + u)), 0, np.inf, epsabs=1e-14)[0]
    known = li.systems.maclaurin_modes(e)
    assert known.sum() == pytest.approx(2 * Omega, rel=1e-14, abs=0)
    assert ((known[0] - known[1]) / 2) ** 2 == pytest.approx(3 * B11 - Omega**2, rel=1e-8)
