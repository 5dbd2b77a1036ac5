"""Eddy currents in a conducting body: the closed form of a sphere, and the sign of the work at any step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lieint_jax import torques
from lieint_jax.groups import so3
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import torqued_body

FIELD, OMEGA = np.array([0.5, -1.0, 1.2]), np.array([0.3, -0.4, 0.8])
TENSOR = np.array([[0.4, 0.1, 0.0], [0.1, 0.3, -0.05], [0.0, -0.05, 0.2]])


@jax.jit
def once(step, state, dt):
    end, info = step(state, dt)
    return end, info.converged, step.system.energy(end) - end.work


def path(step, state, dt, num_steps):
    """The last state, and the largest |H − W − H₀| and |Δπ·b| of the run."""
    start = step.system.energy(state) - state.work
    z, most = state, np.zeros(2)
    for _ in range(num_steps):
        z, converged, balance = once(step, z, dt)
        assert converged
        most = np.maximum(most, np.abs([balance - start, (np.asarray(z.p) - np.asarray(state.p)) @ FIELD]))
    return z, *most


def test_a_sphere_loses_its_rotation_across_the_field_as_in_closed_form():
    """π∥ is constant, π⊥ = π⊥(0) exp(−k|b|²t/J). Both balances are round-off."""
    k, J, end = 0.2, 1.7, 4.0
    body = torqued_body([J, J, J], torques.eddy_current(k, FIELD))
    state = body.state([0.8, -0.3, 0.4, np.sqrt(0.11)], angular_velocity=OMEGA, work=0.0)
    along = FIELD * (FIELD @ state.p) / (FIELD @ FIELD)
    exact = along + (state.p - along) * np.exp(-k * FIELD @ FIELD * end / J)
    errors = []
    for n in (20, 40):
        z, balance, moved = path(torqued_midpoint(body), state, end / n, n)
        assert max(balance, moved) < 2e-15
        errors.append(np.abs(z.p - exact).max())
    assert errors[-1] < 1e-3
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.02


def test_a_number_and_a_multiple_of_the_identity_are_the_torque_of_the_literature():
    """−k(|b|²ω − b(b·ω)) for a number, and (M(ω × b)) × b in body axes for a tensor."""
    q = so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2]))
    B = np.asarray(so3.Ad_star(q, FIELD))
    for tensor in (0.2, [0.2] * 3, 0.2 * np.eye(3)):
        found = torques.eddy_current(tensor, FIELD)(jnp.zeros(()), q, OMEGA)
        np.testing.assert_allclose(found, -0.2 * (B @ B * OMEGA - B * (B @ OMEGA)), rtol=1e-13)
    found = torques.eddy_current(TENSOR, FIELD)(jnp.zeros(()), q, OMEGA)
    np.testing.assert_allclose(found, np.cross(TENSOR @ np.cross(OMEGA, B), B), rtol=1e-13)


@jax.jit
def work_of_step(root, field, omega, dt):
    """The work and the energy gained in one step of a tensor rootᵀroot, and whether it converged."""
    body = torqued_body(jnp.array([1.0, 2.0, 2.5]), torques.eddy_current(root.T @ root, field))
    state = body.state(angular_velocity=omega, work=0.0)
    end, info = torqued_midpoint(body)(state, dt)
    return end.work, body.energy(end) - body.energy(state), body.energy(state), info.converged


numbers = st.floats(-3, 3, allow_subnormal=False)
vectors = st.lists(numbers, min_size=3, max_size=3).map(np.array)


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(st.lists(vectors, min_size=3, max_size=3), vectors, vectors, st.floats(1e-3, 1e3), st.booleans())
def test_the_work_of_a_step_is_never_positive(root, field, omega, dt, singular):
    root = np.stack(root)
    root[2] *= not singular
    work, gained, energy, converged = work_of_step(root, field, omega, dt)
    assert work <= 0
    if converged:
        stiffness = dt * np.sum(root**2) * (field @ field)
        assert abs(gained - work) <= 2e-14 * (1 + stiffness) * energy


@pytest.mark.long
def test_a_body_comes_to_rest_in_a_field_that_turns_with_it():
    """With the rate of the field a body that rotates with the field has no torque, and a body at rest is driven."""
    spin = np.array([0.0, 0.0, 0.7])

    def field(t):
        return jnp.stack([jnp.cos(0.7 * t), jnp.sin(0.7 * t), 0.3 + 0 * t])

    law = torques.eddy_current(0.2, field, jax.jacfwd(field))
    q = so3.identity
    np.testing.assert_allclose(law(jnp.zeros(()), q, spin), 0, rtol=0, atol=1e-16)
    assert law(jnp.zeros(()), q, np.zeros(3))[2] > 0.1
    body = torqued_body([1.0, 1.3, 1.5], law)
    z, balance, _ = path(torqued_midpoint(body), body.state(angular_velocity=[0.2, 0, 0], work=0.0), 0.05, 100)
    assert balance < 1e-14
    assert z.work > 0.01
