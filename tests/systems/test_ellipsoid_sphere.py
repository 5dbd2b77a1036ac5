"""The potential of an ellipsoid at any distance and aspect, against quadrature and closed forms in many digits."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lieint_jax.potentials import _ellipsoid_sphere, ellipsoid_sphere

pytestmark = pytest.mark.long

ASPECTS = [1.0, 3.0, 30.0, 100.0, 1000.0]
SHAPES = {
    "oblate": lambda k: [1.0, 1.0, 1 / k],
    "prolate": lambda k: [1 / k, 1.0, 1 / k],
    "triaxial": lambda k: [1.0, k**-0.5, 1 / k],
}
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 2, 3], [1, 1, 1e-3], [1e-4, 1, 1e-5]])
HEIGHTS = [1.0, 1 + 1e-6, 1.01, 1.3, 3.0, 100.0]  # in units of the surface


def points(a):
    """Points on the surface, close to it and far away; and between the focal ellipse and the surface's normal."""
    on = DIRECTIONS / np.sqrt(np.sum((DIRECTIONS / a) ** 2, axis=1, keepdims=True))
    normal = np.concatenate([h * on for h in HEIGHTS] + [on + d * DIRECTIONS for d in (1e-3, 0.5)])
    return np.concatenate([normal, 0.5 * on[-2:], np.zeros((1, 3))])


@functools.cache
def reference(a, x):
    """V and its gradient of a unit mass: ∂V/∂x_i = x_i ∫_λ^∞ …, λ by bisection, to 40 digits."""
    with mpmath.workdps(40):
        squares, axes = [mpmath.mpf(float(v)) ** 2 for v in x], [mpmath.mpf(float(v)) ** 2 for v in a]
        phi = lambda at: sum(s / (b + at) for s, b in zip(squares, axes, strict=True))  # noqa: E731
        low, high = mpmath.mpf(0), sum(squares)
        if phi(0) > 1:
            for _ in range(160):
                middle = (low + high) / 2
                low, high = (middle, high) if phi(middle) > 1 else (low, middle)
        p, q, r = (b + low for b in axes)
        RD = [mpmath.elliprd(q, r, p), mpmath.elliprd(r, p, q), mpmath.elliprd(p, q, r)]
        value = -(1.5 * mpmath.elliprf(p, q, r) - sum(s * d for s, d in zip(squares, RD, strict=True)) / 2)
        return float(value), [float(mpmath.mpf(float(v)) * d) for v, d in zip(x, RD, strict=True)]


def force(x, a):
    return jax.grad(ellipsoid_sphere(1.0, [1.0, 1.0], a).value)(x)


@pytest.mark.parametrize("shape", ["triaxial", "oblate", "prolate"])
def test_the_potential_and_the_force_of_any_ellipsoid(shape):
    """V to 1e-14 (observed: 3e-15); the force to what roundings of the point and the axes change (observed: 10 eps)."""

    @jax.jit
    @jax.vmap
    def evaluated(a, x):
        by_x, by_a = jax.jacfwd(force, (0, 1))(x, a)
        change = jnp.abs(by_x) @ jnp.abs(x) + jnp.abs(by_a) @ a
        return ellipsoid_sphere(1.0, [1.0, 1.0], a).value(x), force(x, a), change

    a, x = zip(*((a, x) for k in ASPECTS for a in [np.array(SHAPES[shape](k))] for x in points(a)), strict=True)
    V, F, change = evaluated(np.array(a), np.array(x))
    exact = [reference(tuple(b), tuple(y)) for b, y in zip(a, x, strict=True)]
    value, slope = (np.array(part) for part in zip(*exact, strict=True))
    np.testing.assert_allclose(V, value, rtol=1e-14, atol=0)
    assert (np.abs(F - slope) <= 16 * np.finfo(float).eps * (np.abs(slope) + change)).all()


def test_second_derivatives_obey_laplace():
    """The trace of the Hessian is 0 outside and 4πGρ inside, forward over reverse and reverse over forward."""
    a = jnp.array([1.0, 0.6, 0.3])
    V = ellipsoid_sphere(1.0, [1.0, 1.0], a)
    for hessian in (jax.hessian(V.value), jax.jacrev(jax.jacfwd(V.value))):
        found = jax.jit(jax.vmap(hessian))(points(np.array(a)))
        trace, size = jnp.trace(found, axis1=1, axis2=2), jnp.abs(found).max(axis=(1, 2))
        np.testing.assert_allclose(trace[7:-3] / size[7:-3], 0, rtol=0, atol=1e-13)
        np.testing.assert_allclose(trace[-3:], 3 / jnp.prod(a), rtol=1e-13)


def test_a_root_that_is_not_found_is_nan(monkeypatch):
    """So that a step reports it."""
    monkeypatch.setattr(_ellipsoid_sphere, "_MOST", 2)
    V = ellipsoid_sphere(1.0, [1.0, 1.0], [1.0, 1.0, 0.01])
    assert np.isnan(V.value(jnp.array([1.0, 0.3, 0.05])))
    assert np.isfinite(V.value(jnp.array([0.0, 0.0, 0.9])))  # one iteration
