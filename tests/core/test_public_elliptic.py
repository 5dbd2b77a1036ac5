"""`li.elliptic` against mpmath over wide ranges, against SciPy at the ends of the domain, and its derivatives."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.special

from lieint_jax import elliptic

EPS = 2.2e-16
M = [0.0, 1e-300, 1e-8, 0.5, 0.9, 1 - 1e-8, 1 - 1.2e-16, -1e-9, -0.7, -1e5, -1e20]
PHI = [1e-9, 0.3, 1.5, np.pi / 2, -2.0, 30.0]


@pytest.fixture(autouse=True)
def digits():
    with mpmath.workdps(50):
        yield


def errors(function, exact, *arguments):
    """The relative errors at these arguments, given in columns."""
    found = function(*(jnp.array(column) for column in arguments))
    true = [mpmath.re(exact(*map(mpmath.mpf, row))) for row in zip(*arguments, strict=True)]
    return [float(abs(mpmath.mpf(float(x)) / y - 1)) if y else abs(float(x)) for x, y in zip(found, true, strict=True)]


def columns(*ranges):
    return [list(column) for column in zip(*((a, b) for a in ranges[0] for b in ranges[1]), strict=True)]


def test_complete_integrals_agree_with_mpmath():
    assert max(errors(elliptic.K, mpmath.ellipk, [*M, -1e200])) < 1e-15  # observed 2.9e-16
    assert max(errors(elliptic.E, mpmath.ellipe, [*M, -1e200])) < 1e-15  # observed 3.9e-16
    n = [0.0, 0.3, 1 - 1e-9, -1e-9, -1e6, -1e12]
    assert max(errors(elliptic.Pi, mpmath.ellippi, *columns(n, M))) < 2e-15  # observed 5.7e-16


@pytest.mark.long
def test_incomplete_integrals_agree_with_mpmath():
    """Beyond a quarter period too."""
    assert max(errors(elliptic.F, mpmath.ellipf, *columns(PHI, M))) < 2e-15  # observed 5.9e-16
    assert max(errors(elliptic.E, mpmath.ellipe, *columns(PHI, M))) < 2e-15  # observed 7.4e-16
    cases = [(n, phi, m) for n in (0.0, 0.9, -0.5, -1e6) for phi in (0.3, -2.0) for m in (0.0, 0.6, 1 - 1e-8, -30.0)]
    cases += [(1.5, 0.7, 0.5), (30.0, 0.1, -2.0)]  # n > 1 up to where the integrand is infinite
    found = errors(elliptic.Pi, mpmath.ellippi, *([float(x) for x in column] for column in zip(*cases, strict=True)))
    assert max(found) < 4e-15  # observed 1.2e-15


def test_jacobi_s_functions_agree_with_mpmath():
    """To a few eps of each function and of its change over |u| eps, also many periods away and for m < 0."""
    cases = [(u, m) for u in (1e-9, 0.3, 1.1, -7.0, 100.0) for m in (0.0, 1e-8, 0.5, 1 - 1e-8, 1.0, -0.7, -1e5, -1e20)]
    u, m = (jnp.array(column) for column in zip(*cases, strict=True))
    found = np.stack([function(u, m) for function in (elliptic.sn, elliptic.cn, elliptic.dn)], axis=1)
    for (a, b), values in zip(cases, found, strict=True):
        exact = sn, cn, dn = [
            mpmath.re(mpmath.ellipfun(kind, mpmath.mpf(a), m=mpmath.mpf(b))) for kind in ("sn", "cn", "dn")
        ]
        for value, x, slope in zip(values, exact, (cn * dn, -sn * dn, -b * sn * cn), strict=True):
            allowed = 10 * EPS * (abs(x) + abs(a * slope))
            assert abs(mpmath.mpf(float(value)) - x) < allowed, (a, b)


@pytest.mark.long
def test_carlson_s_integrals_agree_with_mpmath():
    """For arguments of any ratio, one of which may be 0, and principal values."""
    sizes = [0.0, 1e-150, 1e-3, 1.0, 1.1, 1e60]
    cases = [(x, y, z) for x in sizes for y in sizes for z in sizes if x <= y and y > 0 and z > 0]
    x, y, z = (list(column) for column in zip(*cases, strict=True))
    assert max(errors(elliptic.RF, mpmath.elliprf, x, y, z)) < 2e-15  # observed 6e-16
    assert max(errors(elliptic.RD, mpmath.elliprd, x, y, z)) < 2e-15  # observed 5.5e-16
    x, y = columns(sizes, [1e-100, 0.97, 3.0, -1e-3, -1.0, -1e5])
    assert max(errors(elliptic.RC, mpmath.elliprc, x, y)) < 2e-15  # observed 3.2e-16


def test_carlson_s_third_integral_agrees_with_mpmath():
    cases = [
        (*xyz, p) for xyz in ((0.0, 1.0, 2.0), (1.0, 1.0, 1.0), (1e-20, 0.3, 1e9)) for p in (1e-30, 0.7, 1.0, 1e20)
    ]
    with mpmath.workdps(160):
        found = errors(elliptic.RJ, mpmath.elliprj, *(list(column) for column in zip(*cases, strict=True)))
    assert max(found) < 2e-15  # observed 6e-16


def principal_value(x, y, z, p):
    """(3/2) ∫ f(t) dt/(t + p), f = 1/√((t + x)(t + y)(t + z)), for p < 0: symmetric about the pole, then beyond."""

    def f(t):
        return 1 / mpmath.sqrt((t + x) * (t + y) * (t + z))

    pole = -mpmath.mpf(p)
    inner = mpmath.quad(lambda s: (f(pole + s) - f(pole - s)) / s, [0, pole])
    return 1.5 * (inner + mpmath.quad(lambda t: f(t) / (t - pole), [2 * pole, 10 * pole, mpmath.inf]))


@pytest.mark.long
def test_principal_values_agree_with_quadrature():
    """R_J for p < 0 against the principal value of its integral, with the pole taken out of it, and its slopes."""
    cases = [(0.3, 1.0, 2.0, -0.5), (1.0, 1.0, 1.0, -2.0), (5.0, 1e-3, 1.0, -1.0)]
    found = elliptic.RJ(*(jnp.array(column) for column in zip(*cases, strict=True)))
    with mpmath.workdps(25):
        for value, case in zip(found, cases, strict=True):
            assert float(value) == pytest.approx(float(principal_value(*case)), rel=2e-15, abs=0), case
    forward = jax.jacfwd(elliptic.RJ, (0, 1, 2, 3))(*cases[0])
    np.testing.assert_allclose(forward, jax.grad(elliptic.RJ, (0, 1, 2, 3))(*cases[0]), rtol=1e-14)
    steps = jnp.array([-3, -2, -1, 1, 2, 3]) * 1e-3
    for k in range(4):
        at = [x + steps * (j == k) for j, x in enumerate(cases[0])]
        differences = jnp.sum(jnp.array([-1, 9, -45, 45, -9, 1]) / 60e-3 * elliptic.RJ(*at))
        assert float(forward[k]) == pytest.approx(float(differences), rel=1e-11, abs=0)


@pytest.mark.long
def test_the_ends_of_the_domain_are_those_of_scipy():
    inf, special = np.inf, scipy.special
    cases = [
        (elliptic.K, special.ellipk, [(1.0,), (1.1,), (-inf,)]),
        (elliptic.E, special.ellipe, [(1.0,), (1.1,), (-inf,)]),
        (elliptic.F, special.ellipkinc, [(1.0, 1.1), (1.6, 1.0), (0.5, 1.0)]),
        (elliptic.E, special.ellipeinc, [(1.0, 1.1), (1.6, 1.0), (10.0, 1.0)]),
        (elliptic.RF, special.elliprf, [(0.0, 0.0, 1.0), (-1.0, 1.0, 1.0), (1.0, 1.0, inf)]),
        (elliptic.RC, special.elliprc, [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (0.0, -1.0), (1.0, inf), (inf, 1.0)]),
        (elliptic.RD, special.elliprd, [(0.0, 0.0, 1.0), (1.0, 1.0, 0.0), (1.0, 1.0, -1.0), (inf, 1.0, 1.0)]),
        (elliptic.RJ, special.elliprj, [(0.0, 0.0, 1.0, 1.0), (1.0, 1.0, 1.0, 0.0), (-1.0, 1.0, 1.0, 1.0)]),
    ]
    for own, other, rows in cases:
        found = own(*(jnp.array(column) for column in zip(*rows, strict=True)))
        np.testing.assert_allclose(found, [other(*row) for row in rows], rtol=1e-15, err_msg=own.__name__)
    assert np.isnan(elliptic.sn(0.5, 1.1))
    assert np.isnan(elliptic.Pi(1.1, 0.5))
    assert np.isinf(elliptic.Pi(1.0, 0.5))
    assert np.isnan(elliptic.Pi(1.5, 1.0, 0.5))  # the integrand is infinite at 0.955


SLOPES = [
    (elliptic.K, mpmath.ellipk, [(0.0,), (0.5,), (1 - 1e-8,), (-1e5,)]),
    (elliptic.E, mpmath.ellipe, [(0.0,), (0.5,), (1 - 1e-8,), (-1e5,)]),
    (elliptic.F, mpmath.ellipf, [(0.3, 0.0), (1.5, 1 - 1e-8), (-2.0, 0.6), (4.0, -1e3)]),
    (elliptic.E, mpmath.ellipe, [(0.3, 0.0), (1.5, 1 - 1e-8), (-2.0, 0.6), (4.0, -1e3)]),
    (elliptic.Pi, mpmath.ellippi, [(0.0, 0.3, 0.4), (0.9, 2.0, 0.6), (-30.0, 1.2, -5.0)]),
    *(
        (own, lambda u, m, kind=kind: mpmath.ellipfun(kind, u, m=m), [(0.3, 0.0), (9.0, 0.6), (1.1, 1.0), (2.0, -50.0)])
        for own, kind in ((elliptic.sn, "sn"), (elliptic.cn, "cn"), (elliptic.dn, "dn"))
    ),
    (elliptic.RF, mpmath.elliprf, [(1.0, 1.0, 1.0), (1e-6, 2.0, 3.0), (5.0, 0.1, 5.0)]),
    (elliptic.RC, mpmath.elliprc, [(1.0, 1.0), (0.2, 3.0), (3.0, 0.2), (1.0, -2.0), (1.0, 1.1)]),
    (elliptic.RD, mpmath.elliprd, [(1.0, 1.0, 1.0), (1e-6, 2.0, 3.0), (5.0, 0.1, 5.0)]),
    (elliptic.RJ, mpmath.elliprj, [(1.0, 1.0, 1.0, 1.0), (1e-6, 2.0, 3.0, 0.1), (1.0, 0.1, 5.0, 9.0)]),
]


CASES = [pytest.param(*case, marks=[pytest.mark.long] * (k not in (0, 1, 2, 5, 8))) for k, case in enumerate(SLOPES)]


@pytest.mark.slow
@pytest.mark.parametrize(("own", "other", "rows"), CASES, ids=lambda x: getattr(x, "__name__", ""))
def test_derivatives_by_every_argument_agree_with_differences_at_50_digits(own, other, rows):
    """By every argument, forwards and in reverse, against differences at 50 digits; observed 2e-15."""
    arguments = [jnp.array(column) for column in zip(*rows, strict=True)]
    every = tuple(range(len(arguments)))
    forward, reverse = (jax.jit(jax.vmap(way(own, every)))(*arguments) for way in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(forward, reverse, rtol=2e-14)  # observed 9.4e-15
    h = mpmath.mpf(10) ** -20
    for i, row in enumerate(rows):
        for k in every:
            up, down = ([mpmath.mpf(x) + sign * h * (j == k) for j, x in enumerate(row)] for sign in (1, -1))
            exact = float(mpmath.re(other(*up) - other(*down)) / (2 * h))
            assert float(forward[k][i]) == pytest.approx(exact, rel=5e-14, abs=1e-15), (row, k)


@pytest.mark.long
def test_derivatives_are_right_where_an_argument_is_0_or_the_integral_infinite():
    """∂R_F/∂y = −R_D(x, z, y)/6 at x = 0 too, where ∂R_F/∂x is infinite: a very large number stands for it."""
    for slopes in (jax.jacfwd(elliptic.RF, (0, 1, 2))(0.0, 1.0, 2.0), jax.grad(elliptic.RF, (0, 1, 2))(0.0, 1.0, 2.0)):
        assert float(slopes[0]) < -1e300
        np.testing.assert_allclose(
            slopes[1:], [-elliptic.RD(0.0, 2.0, 1.0) / 6, -elliptic.RD(0.0, 1.0, 2.0) / 6], rtol=4e-15
        )
    assert jax.grad(elliptic.K)(1.0) == np.inf
    assert jax.grad(elliptic.E)(1.0) == -np.inf


@pytest.mark.long
def test_second_derivatives_at_zero_are_those_of_the_power_series():
    """K″ and E″ at m = 0, from the power series: 9π/64 and −3π/64."""
    assert float(jax.grad(jax.grad(elliptic.K))(0.0)) == pytest.approx(9 * np.pi / 64, rel=1e-14, abs=0)
    assert float(jax.jacfwd(jax.grad(elliptic.E))(0.0)) == pytest.approx(-3 * np.pi / 64, rel=1e-14, abs=0)


@pytest.mark.long
def test_elliptic_functions_accept_float32_batches_and_integers():
    m = jnp.array([[0.0, 0.5, 1 - 1e-6], [-1.0, -1e4, 0.9]], "float32")
    for found, exact in (
        (elliptic.K(m), scipy.special.ellipk(np.asarray(m, float))),
        (elliptic.E(m), scipy.special.ellipe(np.asarray(m, float))),
        (elliptic.F(jnp.float32(1.3), m), scipy.special.ellipkinc(float(jnp.float32(1.3)), np.asarray(m, float))),
        (elliptic.RJ(m**2, 1.0, 2.0, 0.3), scipy.special.elliprj(np.asarray(m**2, float), 1, 2, 0.3)),
    ):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, exact, rtol=1e-6)  # observed 2.5e-7
    assert float(elliptic.K(0)) == pytest.approx(np.pi / 2, rel=1e-15, abs=0)
