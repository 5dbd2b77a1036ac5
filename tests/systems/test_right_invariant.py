"""Right-invariant metrics (end of Section 5.1.7): the mirror of the left-invariant ones, Π conserved in place of π."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated import once

import lieint_jax as li
from lieint_jax import groups
from lieint_jax.diagnostics import certify, flow, poisson_error

pytestmark = pytest.mark.long

CATALOGUE = {
    "SL(2)": (groups.special_linear(2), [1.0, 2.0, 3.0], [0.3, -0.2, 0.4]),
    "SO(3)": (groups.so3, [1.0, 2.0, 3.0], [0.2, 0.5, 1.0]),
    "SE(2)": (groups.special_euclidean(2), np.diag([1.0, 2, 3]) + 0.3, [0.6, -0.4, 0.5]),
    "Aff(1)": (groups.affine(1), [1.0, 2.0], [0.4, 0.7]),
}


def system_and_state(name, turn=0.4):
    group, metric, velocity = CATALOGUE[name]
    system = li.systems.euler(group, metric, invariance="right")
    q = jax.jit(group.exp)(turn * jnp.sin(jnp.arange(1.0, group.dim + 1)))
    return system, system.state(q, velocity=velocity)


@pytest.mark.paper("5.1.7, its end", "right-invariant energy", "systems/_euler.py")
@pytest.mark.parametrize("name", CATALOGUE)
def test_energy_and_body_momentum_are_conserved_and_the_order_is_two(name):
    system, state = system_and_state(name)
    step = li.schemes.group_midpoint(system)
    found = certify(step, state, 0.1, 40)
    assert found.converged
    assert found.energy < 2e-14  # floor 4e-15
    assert found.momentum < 6e-14  # floor 1e-14: Π is no variable of the state, so its rounding errors add up
    assert found.order == pytest.approx(2, abs=0.03)  # against the flow of the vector field
    assert found.reversibility < 4e-15
    after = once(step, state, 0.1)[0]
    assert np.abs(after.p - state.p).max() > 1e-3  # π is not conserved


@pytest.mark.quick
def test_a_step_follows_the_vector_field():
    """By the central difference of two steps: a step of −Δt would keep Π and the energy too."""
    system, state = system_and_state("Aff(1)")
    step, h = li.schemes.group_midpoint(system), 1e-3
    ahead, behind = (once(step, state, dt)[0] for dt in (h, -h))
    field = system.vector_field(state)
    for a, b, rate in zip(ahead[:2], behind[:2], field[:2], strict=True):
        np.testing.assert_allclose((a - b) / (2 * h), rate, rtol=0, atol=1e-5)
    assert np.abs(field.p).max() > 1e-2


@pytest.mark.parametrize("name", CATALOGUE)
def test_inversion_maps_a_right_invariant_flow_to_a_left_invariant_one(name):
    """q ↦ q⁻¹ makes a right-invariant motion a left-invariant one, with spatial momentum −Π; steps too."""
    group, metric, _ = CATALOGUE[name]
    system, state = system_and_state(name)
    mirror = li.systems.euler(group, metric)
    image = lambda z: li.State(group.inverse(z.q), -group.Ad_star(z.q, z.p))  # noqa: E731
    there = jax.jit(image)(state)
    assert system.energy(state) == pytest.approx(float(mirror.energy(there)), rel=1e-14, abs=0)
    moved, reflected = jax.jit(flow, static_argnums=(0, 3))(system, state, 0.7, 4), flow(mirror, there, 0.7, 4)
    for a, b in zip(jax.jit(image)(moved)[:2], reflected[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-14)
    step, other = li.schemes.group_midpoint(system), li.schemes.group_midpoint(mirror)
    for a, b in zip(jax.jit(image)(once(step, state, 0.3)[0])[:2], once(other, there, 0.3)[0][:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=8e-15)


def test_symplectic_with_the_arcsine_map_and_not_with_the_exponential():
    """Inversion is a symplectic map of T*G: the form is kept exactly where the left-invariant step keeps it."""
    system, state = system_and_state("SL(2)")
    kept, lost = (
        certify(li.schemes.group_midpoint(system, tau), state, 0.2, 4) for tau in (li.maps.arcsine, li.maps.exponential)
    )
    assert kept.symplectic_defect < 8e-15
    assert lost.symplectic_defect > 1e-5
    assert lost.symplectic_order == pytest.approx(3, abs=0.1)


def test_the_poisson_error_is_that_of_the_whole_form():
    """(5.36) is of steps with π constant: here the product alone, and the recursion refused."""
    system, state = system_and_state("SL(2)")
    step = li.schemes.group_midpoint(system, li.maps.arcsine)
    error = jax.jit(lambda z: poisson_error(step, z, 0.2, 3))(state)
    assert error.shape == (4, 6, 6)
    assert np.abs(error).max() < 2e-14
    with pytest.raises(ValueError, match=r"left-invariant systems on T.G without potential, got RightEuler"):
        poisson_error(step, state, 0.2, 3, method="recursion")


def test_a_step_that_lost_the_digits_of_its_momentum_is_flagged():
    """On SL(2) Ad_q grows along a motion, and Π = Ad*_q π comes to be a small difference of large terms."""
    system, state = system_and_state("SL(2)")
    step = li.schemes.group_midpoint(system)
    run = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))(step, state, 0.1, 600, save_every=60)
    error = np.abs(li.Run.of(step, run).momentum_error()).max(axis=1)
    good = np.asarray(run.info.converged)
    assert good[:3].all()
    assert not good[-1]
    assert error[good].max() < 1e-5


def test_a_body_momentum_gives_the_state_and_too_large_a_step_is_refused():
    system, state = system_and_state("SO(3)")
    with pytest.raises(ValueError, match="smaller"):
        li.schemes.group_midpoint(system).check(state, 50.0)
    given = system.state(state.q, body_momentum=system.momentum(state))
    np.testing.assert_allclose(given.p, state.p, rtol=0, atol=1e-15)
