"""Pseudo-rigid bodies: equations of motion, materials and their stresses, states, errors."""

import doctest

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from paper import hat

import lieint_jax as li
from lieint_jax import systems
from lieint_jax._numerics import power_series, vectors
from lieint_jax.core import State

MATERIALS = {
    "mooney_rivlin": systems.mooney_rivlin(2000.0, 6.0),
    "neo_hookean": systems.neo_hookean(20.0, 6.0),
    "saint_venant_kirchhoff": systems.saint_venant_kirchhoff(20.0, 6.0),
    "user": systems.pseudo_rigid_body(np.ones(3), lambda C: jnp.trace(C @ C) - 6 * jnp.log(jnp.linalg.det(C))),
}
MATERIALS["user"] = MATERIALS["user"].stored_energy
E = np.array([[1.0, 0.1, 0], [0.1, 1.5, -0.2], [0, -0.2, 2.5]])
F = np.array([[1.1, 0.02, 0.0], [0.0, 0.95, 0.05], [-0.03, 0.0, 1.0]])
P = np.array([[0.3, -1.0, 0.2], [0.8, 0.1, 0.5], [-0.4, 0.6, -0.2]])
C = F.T @ F
D = np.array([[0.1, 0.03, -0.02], [0.03, -0.05, 0.04], [-0.02, 0.04, 0.08]])


def matrix(S):
    return np.array(S.rows)


@pytest.mark.long
@pytest.mark.parametrize("name", MATERIALS)
def test_stress_is_twice_the_gradient_and_the_mean_stress_gives_the_difference(name):
    W = MATERIALS[name]
    gradient = np.array(jax.grad(lambda A: W((A + A.T) / 2))(jnp.array(C)))
    np.testing.assert_allclose(matrix(W.stress(vectors.symmetric(jnp.array(C)))), 2 * gradient, rtol=1e-12, atol=1e-11)
    mean = matrix(W.mean_stress(vectors.symmetric(jnp.array(C)), vectors.symmetric(jnp.array(D))))
    assert np.sum(mean * D) / 2 == pytest.approx(float(W(C + D) - W(C)), abs=4e-13 * max(1, np.abs(mean).max()))
    limit = matrix(W.mean_stress(vectors.symmetric(jnp.array(C)), vectors.symmetric(jnp.zeros((3, 3)))))
    np.testing.assert_allclose(limit, 2 * gradient, rtol=1e-12, atol=1e-11)


def test_every_mean_stress_gives_the_difference_of_the_energy():
    """½S̄:D = W(C + D) − W(C), of all materials in one program."""

    @jax.jit
    def both(A, B):
        means = [W.mean_stress(vectors.symmetric(A), vectors.symmetric(B)) for W in MATERIALS.values()]
        return [S.inner(vectors.symmetric(B)) / 2 for S in means], [W(A + B) - W(A) for W in MATERIALS.values()]

    for own, difference in zip(*both(C, D), strict=True):
        assert float(own) == pytest.approx(float(difference), rel=1e-12, abs=0)


@pytest.mark.parametrize("size", [1e-2, 1e-5, 1e-9])
def test_the_mean_stress_does_not_cancel(size):
    """Against 40 digits: a difference quotient of W loses eps·W/|ΔC| instead, all digits but five at |ΔC| = 1e-9."""
    W = MATERIALS["mooney_rivlin"]
    mean = matrix(W.mean_stress(vectors.symmetric(jnp.array(C)), vectors.symmetric(jnp.array(size * D))))
    with mpmath.workdps(40):

        def exact(A):
            I3 = mpmath.det(A)
            return 1000 * (I3 - 1 - mpmath.log(I3)) + 3 * (A[0, 0] + A[1, 1] + A[2, 2] - 3 - mpmath.log(I3))

        start, change = mpmath.matrix(C.tolist()), mpmath.matrix((size * D).tolist())
        quotient = float((exact(start + change) - exact(start)) / size)
    assert np.sum(mean * D) / 2 == pytest.approx(quotient, rel=1e-12, abs=0)


@pytest.mark.long
def test_log1p_ratio_is_accurate_on_both_sides_of_its_threshold():
    for y in (-0.5, -0.1000001, -0.0999999, -1e-9, 0.0, 1e-300, 1e-9, 0.0999999, 0.1000001, 3.0):
        value, slope = power_series.log1p_ratio(jnp.array(y)), jax.grad(power_series.log1p_ratio)(jnp.array(y))
        with mpmath.workdps(40):
            x = mpmath.mpf(y)
            exact = mpmath.log1p(x) / x if y else mpmath.mpf(1)
            exact_slope = (1 / (1 + x) - exact) / x if abs(y) > 1e-12 else mpmath.mpf(-0.5)
        assert float(value) == pytest.approx(float(exact), rel=4e-16, abs=0)
        assert float(slope) == pytest.approx(float(exact_slope), rel=1e-14, abs=0)


def test_energy_is_invariant_and_momentum_equivariant_under_rotations_in_space():
    body = systems.pseudo_rigid_body(E, MATERIALS["mooney_rivlin"])
    Q = np.array(li.groups.so3.to_matrix(li.groups.so3.exp(jnp.array([0.4, -0.7, 0.2]))))
    turned = body.state(Q @ F, momentum=Q @ P)
    assert float(body.energy(turned)) == pytest.approx(float(body.energy(body.state(F, momentum=P))), rel=1e-13, abs=0)
    np.testing.assert_allclose(body.momentum(turned), Q @ body.momentum(body.state(F, momentum=P)), rtol=0, atol=1e-15)


def test_states_of_a_pseudo_rigid_body_have_the_given_motion():
    body = systems.pseudo_rigid_body(E, MATERIALS["neo_hookean"])
    V = np.array(body.velocity(body.state(F, momentum=P)))
    np.testing.assert_allclose(body.state(F, velocity=V).p, P, rtol=0, atol=1e-15)
    spin = np.array([0.3, 0.2, -0.5])
    np.testing.assert_allclose(body.state(F, angular_velocity=spin).p, hat(spin) @ F @ E, rtol=0, atol=1e-15)
    np.testing.assert_allclose(body.strain(body.state(F, momentum=P)), C, rtol=0, atol=1e-15)
    diagonal = systems.pseudo_rigid_body([1.0, 2.0, 3.0], MATERIALS["neo_hookean"])
    np.testing.assert_allclose(diagonal.state(F, velocity=V).p, V @ np.diag([1.0, 2, 3]), rtol=0, atol=1e-15)
    outside = State(-jnp.eye(3), jnp.zeros((3, 3)))
    assert body.phase_space.defect(outside) == 1
    assert body.phase_space.defect(body.state(F, momentum=P)) == 0


@pytest.mark.parametrize("factory", [systems.pseudo_rigid_body, systems.pendulum], ids=lambda f: f.__name__)
def test_the_examples_of_the_constructors_run(factory):
    globs = {name: getattr(systems, name) for name in ("pseudo_rigid_body", "pendulum", "mooney_rivlin")}
    [example] = doctest.DocTestFinder().find(factory, globs=globs, name="x")
    results = doctest.DocTestRunner().run(example)
    assert results.attempted >= 3
    assert results.failed == 0
