"""Jacobi's functions, K and R_J against mpmath at 160 digits: both branches, their seam, and both ends."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lieint_jax._numerics import elliptic

pytestmark = pytest.mark.long

EPS = 2.2e-16
M1 = [1.0, 1 - 1e-16, 1 - 1e-8, 0.9, 0.500001, 0.5, 0.499999, 0.1, 1e-3, 1e-8, 1e-16, 1e-30, 1e-100]

JACOBIAN = jax.jit(lambda u, m1: tuple(zip(*jax.jacfwd(elliptic.jacobi, argnums=(0, 1))(u, m1), strict=True)))


@pytest.fixture(autouse=True)
def digits():
    with mpmath.workdps(160):
        yield


@pytest.mark.quick
def test_the_quarter_period_agrees_with_mpmath():
    K = jax.jit(jax.vmap(elliptic.quarter_period))(jnp.array(M1))
    exact = [mpmath.ellipk(1 - mpmath.mpf(m1)) for m1 in M1]
    assert max(abs(float(mpmath.mpf(float(a)) / b - 1)) for a, b in zip(K, exact, strict=True)) < 1e-15  # floor 3e-16
    assert np.isfinite(elliptic.quarter_period(jnp.array(0.0)))


def test_jacobi_functions_agree_with_mpmath():
    """Each function to a few eps of itself and of its change over u·eps."""
    function = jax.jit(jax.vmap(elliptic.jacobi))
    cases = []
    for m1 in M1:
        K = float(mpmath.ellipk(1 - mpmath.mpf(m1)))
        cases += [(m1, f * K) for f in (1e-9, 0.01, 0.3, 0.5, 0.77, 0.99, 1.0, -0.6)]
    u, m1 = jnp.array([c[1] for c in cases]), jnp.array([c[0] for c in cases])
    found = np.stack(function(u, m1), axis=1)
    for (m1, u), values in zip(cases, found, strict=True):
        m = 1 - mpmath.mpf(m1)
        sn, cn, dn = (mpmath.ellipfun(kind, mpmath.mpf(u), m=m) for kind in ("sn", "cn", "dn"))
        slopes = (cn * dn, -sn * dn, -m * sn * cn)
        for value, exact, slope in zip(values, (sn, cn, dn), slopes, strict=True):
            allowed = EPS * (abs(exact) + abs(u * slope))
            assert abs(mpmath.mpf(float(value)) - exact) < 6 * allowed, (m1, u)  # floor 2.4


@pytest.mark.parametrize("m1", [1.0, 0.7, 0.5, 0.2, 1e-6, 0.0])
def test_derivatives_of_jacobi_functions_are_exact_also_at_the_ends(m1):
    """In u, the defining equations; in m1 against mpmath. At 0 and at 1 too."""
    u = 1.1
    of_u, of_m1 = JACOBIAN(jnp.array(u), jnp.array(m1))
    sn, cn, dn = elliptic.jacobi(jnp.array(u), jnp.array(m1))
    assert np.abs(np.array(of_u) - np.array([cn * dn, -sn * dn, -(1 - m1) * sn * cn])).max() < 1e-15  # floor 3e-16
    h = mpmath.mpf(10) ** -40
    for value, kind in zip(of_m1, ("sn", "cn", "dn"), strict=True):
        up, down = (mpmath.ellipfun(kind, mpmath.mpf(u), m=1 - mpmath.mpf(m1) + s * h) for s in (-1, 1))
        assert float(value) == pytest.approx(float(mpmath.re(up - down) / (2 * h)), abs=2e-15)


def test_jacobi_functions_are_elementary_at_the_ends_of_the_parameter():
    u = jnp.linspace(-3, 3, 13)
    circle = elliptic.jacobi(u, jnp.ones_like(u))
    assert np.abs(np.array(circle) - np.array([np.sin(u), np.cos(u), np.ones(13)])).max() < 5e-16
    line = elliptic.jacobi(u, jnp.zeros_like(u))
    assert np.abs(np.array(line) - np.array([np.tanh(u), 1 / np.cosh(u), 1 / np.cosh(u)])).max() < 5e-16


def test_carlson_rj_agrees_with_mpmath():
    cases = [
        (x, y, p) for x in (0, 1e-30, 1e-5, 0.2, 1) for y in (1, 0.5, 1e-3, 1e-20, 1e-60) for p in (1, 1.001, 2, 1e2)
    ]
    rx, ry, p = (jnp.array(c) for c in zip(*((x**0.5, y**0.5, float(p)) for x, y, p in cases), strict=True))
    found = jax.jit(jax.vmap(elliptic.carlson_rj))(rx, ry, jnp.ones_like(rx), p)  # each duplicates as often as it needs
    with mpmath.workdps(80):
        for value, a, b, c in zip(found, rx, ry, p, strict=True):
            exact = mpmath.elliprj(mpmath.mpf(float(a)) ** 2, mpmath.mpf(float(b)) ** 2, 1, mpmath.mpf(float(c)))
            assert abs(mpmath.mpf(float(value)) / exact - 1) < 2e-15  # floor 6e-16


def test_derivatives_of_carlson_rj_agree_with_mpmath():
    """By all four arguments, forwards and in reverse, where x = 0 and where p = z too; observed 8e-16."""
    cases = [(x, y, p) for x in (0, 1e-10, 0.2) for y in (0.5, 1e-3) for p in (1.0, 1.001, 1e2)]
    x, y, p = (jnp.array(c) for c in zip(*cases, strict=True))
    roots, every = (jnp.sqrt(x), jnp.sqrt(y), jnp.ones_like(x), p), (0, 1, 2, 3)
    forward, reverse = (jax.jit(jax.vmap(way(elliptic.carlson_rj, every)))(*roots) for way in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(forward, reverse, rtol=1e-15)
    for n, found in enumerate(zip(*forward, strict=True)):
        at = [mpmath.mpf(float(r[n])) for r in roots]
        for k, slope in enumerate(found):
            h = mpmath.mpf(10) ** -40
            up, down = ([a + sign * h * (i == k) for i, a in enumerate(at)] for sign in (1, -1))
            exact = (_rj(*up) - _rj(*down)) / (2 * h) if at[k] else -3 / (at[1] * at[2] * at[3])
            assert abs(mpmath.mpf(float(slope)) / exact - 1) < 3e-15, (n, k)


def _rj(a, b, c, p):
    return mpmath.elliprj(a * a, b * b, c * c, p)


def test_elliptic_functions_are_finite_in_float32():
    m1 = jnp.array([*M1, 0.0], "float32")
    for x in (*elliptic.jacobi(jnp.full_like(m1, 1.3), m1), elliptic.quarter_period(m1)):
        assert x.dtype == jnp.float32
        assert np.isfinite(x).all()


@pytest.mark.quick
def test_r_d_of_two_orders_agrees_with_mpmath():
    """R_D(x, z, y) and R_D(x, y, z): also of a quarter period, with a tiny y, and of equal arguments."""
    cases = [(0.0, 1.0, 1.0), (0.0, 1e-3, 1.0), (0.0, 1e-77, 1.0), (0.5, 0.7, 1.0), (1.0, 1.0, 1.0), (0.9, 0.99, 1.0)]
    found = np.array(jax.jit(jax.vmap(elliptic.carlson_rds))(*np.array(cases).T)).T
    for (x, y, z), values in zip(cases, found, strict=True):
        x, y, z = (mpmath.mpf(r) ** 2 for r in (x, y, z))
        for value, exact in zip(values, (mpmath.elliprj(x, z, y, y), mpmath.elliprj(x, y, z, z)), strict=True):
            assert float(mpmath.mpf(float(value)) / exact - 1) == pytest.approx(0, abs=1e-15)
