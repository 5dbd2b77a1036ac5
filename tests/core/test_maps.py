"""κ's and maps: values and derivatives against mpmath, smooth at 0, each at its limit."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import paper
import pytest

import lieint_jax as li
from lieint_jax import maps
from lieint_jax.groups import so3

EXACT = {
    "cayley": lambda x: mpmath.mpf(1),
    "exponential": lambda x: mpmath.tan(mpmath.sqrt(x) / 2) / (mpmath.sqrt(x) / 2),
    "symplectic": lambda x: 2 / (1 + mpmath.sqrt(1 - x)),
}


@pytest.mark.parametrize("name", EXACT)
def test_kappa_and_its_derivative_against_mpmath(name):
    kappa = getattr(maps, f"kappa_{name}")
    value_and_slope = jax.jit(jax.value_and_grad(kappa))
    with mpmath.workdps(40):
        for angle in (1e-6, 0.01, 0.3, 0.9) + ((2.0, 3.0) if name == "exponential" else ()):
            x = angle**2
            value, slope = (float(y) for y in value_and_slope(x))
            assert value == pytest.approx(float(EXACT[name](mpmath.mpf(x))), rel=3e-15, abs=0)
            assert slope == pytest.approx(float(mpmath.diff(EXACT[name], mpmath.mpf(x))), rel=4e-15, abs=0)


@pytest.mark.parametrize(("name", "slope"), [("cayley", 0), ("exponential", 1 / 12), ("symplectic", 1 / 4)])
def test_kappa_is_one_and_smooth_at_zero(name, slope):
    kappa = getattr(maps, f"kappa_{name}")
    value, first, second = jax.jit(lambda x: (kappa(x), jax.grad(kappa)(x), jax.grad(jax.grad(kappa))(x)))(0.0)
    assert value == 1
    assert first == pytest.approx(slope, rel=1e-15, abs=0)
    assert np.isfinite(second)


def test_exponential_kappa_is_exact_up_to_its_pole():
    """The quotient of polynomials that stands for tan: its error at 179.9°, beside the pole, against mpmath."""
    x = (0.9995 * np.pi) ** 2
    exact = EXACT["exponential"](mpmath.mpf(float(x)))
    assert float(maps.kappa_exponential(jnp.array(x))) == pytest.approx(float(exact), rel=1e-12, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", maps.examples())
def test_maps_land_in_the_group_fix_their_axis_and_start_as_the_identity(name):
    tau, theta = maps.examples()[name], np.array([0.3, -0.5, 0.4])

    @jax.jit
    def measured(theta):
        q = tau(so3, theta)
        return so3.defect(q), so3.Ad(q, theta), q, maps.derivative(tau, so3, theta), _along(tau, theta)

    defect, turned, _, H, along = (np.asarray(x) for x in measured(theta))
    assert abs(defect) < 4e-16
    np.testing.assert_allclose(turned, theta, rtol=0, atol=2e-16)  # Ad_τ(Θ) Θ = Θ: Result 10's condition
    np.testing.assert_allclose(H @ theta, along, rtol=0, atol=4e-16)
    _, _, one, H, _ = measured(0 * theta)
    np.testing.assert_array_equal(one, so3.identity)
    np.testing.assert_allclose(H, np.eye(3), rtol=0, atol=1e-16)


def _along(tau, theta):
    """d/ds of τ(sΘ) at s = 1 is along Θ: a rotation about it that speeds up."""
    return so3.body_velocity(tau(so3, theta), jax.jvp(lambda s: tau(so3, s * theta), (1.0,), (1.0,))[1])


@pytest.mark.paper("2.2: (2.29)", "κ of the exponential map", "maps/_kappa.py")
def test_scaled_cayley_is_the_map_it_is_scaled_to():
    theta = np.array([0.3, -0.5, 0.4])
    angle = np.linalg.norm(theta)
    exact = paper.exp(theta), paper.cay(theta), paper.exp(np.arcsin(angle) / angle * theta)
    for kappa, R in zip((maps.kappa_exponential, maps.kappa_cayley, maps.kappa_symplectic), exact, strict=True):
        np.testing.assert_allclose(
            so3.to_matrix(maps.scaled_cayley(kappa)(so3, jnp.array(theta))), R, rtol=0, atol=4e-16
        )


def test_custom_kappas_are_functions_with_or_without_parameters():
    assert maps.as_kappa(maps.kappa_cayley) is maps.kappa_cayley
    kappa = maps.as_kappa(lambda x: 1 + x)
    assert kappa(2.0) == 3
    assert jax.tree.leaves(kappa) == []
    li.schemes.so3_midpoint(li.systems.rigid_body([1.0, 2.0, 3.0]), lambda x: 1)  # as an integer
    parameter = maps.as_kappa(jax.tree_util.Partial(lambda c, x: 1 + c * x, 0.5))
    assert jax.tree.leaves(parameter) == [0.5]
    with pytest.raises(ValueError, match="callable"):
        li.maps.as_kappa(3.0)
