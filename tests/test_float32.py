"""Everything works in float32, at its own precision: no float64 creeps in, the flags mean the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

EPS = np.finfo(np.float32).eps


@pytest.fixture(autouse=True)
def single():
    with jax.enable_x64(False):
        yield


@pytest.mark.parametrize("kappa", [kappa_cayley, kappa_exponential, kappa_symplectic], ids=lambda k: k.name)
def test_a_run_in_single_precision(kappa):
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    step = li.schemes.so3_midpoint(body, kappa)
    run = li.integrate(step, state, 0.05, 1000, 10)
    assert all(x.dtype == jnp.float32 for x in (run.t, *run.state, run.info.residual))
    assert run.info.converged.all()
    energy = li.diagnostics.energy_error(body, run) / body.energy(state)
    assert np.abs(energy).max() < 16 * EPS  # floor 4 eps
    assert np.abs(li.diagnostics.constraint_error(body, run)).max() < 8 * EPS
    assert (run.state.p == run.state.p[0]).all()
    assert not step(state, 1.2 if kappa.name == "symplectic" else 40.0)[1].converged


def test_the_form_in_single_precision():
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    defects = [
        float(li.diagnostics.symplectic_defect(li.schemes.so3_midpoint(body, k), state, 0.4))
        for k in (kappa_symplectic, kappa_cayley)
    ]
    assert defects[0] < 16 * EPS
    assert defects[1] > 1e-3


def test_certificate_says_single_precision():
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    certificate = li.diagnostics.certify(li.schemes.so3_midpoint(body), state, 0.2, 200)
    assert "float32" in str(certificate)
    assert certificate.symplectic_order == np.inf
    assert certificate.order == pytest.approx(2, abs=0.05)


def test_the_group_in_single_precision():
    v = jnp.array([0.3, -0.5, 0.4])
    for scale in (0.0, 1e-20, 1e-4, 1.0, 4.0):
        np.testing.assert_allclose(so3.log(so3.exp(scale * v)), scale * v, atol=8 * EPS)
        assert np.isfinite(jax.jacfwd(lambda v: so3.log(so3.exp(v)))(scale * v)).all()
    assert so3.exp(v).dtype == jnp.float32
    assert so3.multiply(so3.exp(v), so3.identity).dtype == jnp.float32


def test_an_asteroid_in_si_units_does_not_overflow():
    """Moments of 1e20 kg m²: their cube is beyond float32, no intermediate is."""
    body = li.systems.rigid_body([3.0836e20, 3.235e20, 1e20])
    state = body.state([1, 0, 0, 0], angular_velocity=[1e-6, 2e-6, -2e-5])
    after, info = li.schemes.so3_midpoint(body)(state, 1000.0)
    assert info.converged
    assert np.isfinite(after.q).all()
