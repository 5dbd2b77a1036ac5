"""Incompressible pseudo-rigid bodies, F in SL(3): volume, energy and momentum at round-off (Section 6.1.1)."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated import once

import lieint_jax as li
from lieint_jax import _discover
from lieint_jax._numerics import vectors
from lieint_jax.diagnostics import flow

pytestmark = pytest.mark.long

BODY, STATE, DT = _discover.modules_with("examples", li.systems)["incompressible_body"].examples()["ball"]
STEP = li.schemes.additive(BODY, "incompressible")
QUICK = {"xla_llvm_disable_expensive_passes": True}
number = st.floats(-1, 1, width=64)
matrices = st.lists(number, min_size=9, max_size=9).map(lambda x: np.reshape(x, (3, 3)))


@jax.jit
def _steps(E, F, V, dt):
    """Ten steps from a deformation and a velocity, made fit: relative errors of energy and momentum, det F − 1."""
    body = li.systems.IncompressibleBody(E, BODY.stored_energy)
    state = body.state(F / jnp.cbrt(jnp.linalg.det(F)), velocity=V)
    step = li.schemes.additive(body, "incompressible")
    run = li.Run.of(step, li.integrate(step, state, dt, 10))
    size = jnp.max(jnp.abs(state.p)) * jnp.max(jnp.abs(state.q))
    volume = jax.vmap(body.phase_space.defect)(run.state)
    return run.energy_error() / body.energy(state), run.momentum_error() / size, volume, run.info.converged


@pytest.mark.paper("6.1.1, 1.1", "incompressible bodies, Q = SL(3)", "systems/_incompressible_body.py")
@hypothesis.settings(max_examples=12)
@hypothesis.given(matrices, matrices, st.tuples(*[st.floats(0.5, 2)] * 3).map(np.array), st.sampled_from([-0.02, 0.02]))
def test_energy_momentum_and_volume_are_conserved(A, V, E, dt):
    F = np.eye(3) + A / 5
    hypothesis.assume(np.abs(V).max() > 0.1)
    energy, momentum, volume, converged = map(np.asarray, _steps(E, F, V, dt))
    assert converged.all()
    assert np.abs(energy).max() < 2e-14  # floor 4e-15, of a W that takes large terms away from each other
    assert np.abs(momentum).max() < 8e-15  # floor 2e-15
    assert np.abs(volume).max() < 4e-15  # floor 1e-15


def test_the_volume_of_stretched_bodies_is_conserved_to_the_rounding_of_det_F():
    """Where the equation was asked of C = FᵀF, whose determinant has the terms |F|⁶, it was off by up to 40."""
    rng = np.random.default_rng(0)
    F = np.array([[1.3, -0.3, 0.8], [-0.8, 1.6, 0.5], [1.0, 0.3, 1.6]]) + rng.normal(size=(1000, 3, 3)) / 50
    P = np.array([[9.6, 0.3, 3.6], [-7.3, 0.2, -0.5], [-1.6, 0.2, 0.1]])
    body = li.systems.incompressible_body([7.7, 0.2, 1.2], li.systems.mooney_rivlin(0.28, 0.14))
    step = li.schemes.additive(body, "incompressible")
    states = li.core.State(F / np.cbrt(np.linalg.det(F))[:, None, None], np.broadcast_to(P, F.shape))
    after, info = jax.jit(jax.vmap(lambda state: step(state, 0.39)))(jax.tree.map(jnp.asarray, states))
    assert info.converged.all()
    off = np.abs(jax.vmap(body.phase_space.defect)(after)) / np.abs(after.q).max((1, 2)) ** 3
    assert off.max() < 6 * np.finfo(float).eps  # floor 2


def test_without_the_pressure_the_volume_changes():
    free = BODY.compressible
    after, info = once(li.schemes.additive(free), STATE, DT)
    assert info.converged
    assert abs(free.phase_space.defect(after)) == 0
    assert abs(np.linalg.det(after.q) - 1) > 1e-4


def test_the_step_is_the_one_that_its_equations_have():
    """U E = Δt P_{n+½} and P₁ − P₀ = −Δt F_{n+½}(S̄ − pS̄₃): what S̄ leaves of the second is along S̄₃, by numpy."""
    after, info = once(STEP, STATE, DT)
    assert info.converged
    (F0, P0), (F1, P1) = (map(np.asarray, z[:2]) for z in (STATE, after))
    np.testing.assert_allclose((F1 - F0) * 2.0, DT * (P0 + P1) / 2, rtol=0, atol=4e-16)
    C, D = F0.T @ F0, F1.T @ F1 - F0.T @ F0
    S = np.array(BODY.stored_energy.mean_stress(vectors.symmetric(C), vectors.symmetric(D)).rows)
    left = np.linalg.solve((F0 + F1) / 2, -(P1 - P0) / DT) - S  # −pS̄₃
    cofactor = lambda C: np.linalg.det(C) * np.linalg.inv(C).T  # noqa: E731
    minor = (np.trace(D) ** 2 - np.trace(D @ D)) / 2 * np.eye(3) - np.trace(D) * D + D @ D  # cof D
    direction = cofactor(C + D / 2) + minor / 12
    assert np.sum(direction * D) == pytest.approx(np.linalg.det(C + D) - np.linalg.det(C), abs=1e-15)
    p = -np.sum(left * direction) / np.sum(direction**2)
    assert abs(p) > 1
    np.testing.assert_allclose(left, -p * direction, rtol=0, atol=1e-10)


def test_second_order_reversible_and_the_hidden_constraint():
    """Against the flow in T*SL(3), of order 16; tr(ḞF⁻¹) at the ends of steps is O(Δt²)."""

    @functools.partial(jax.jit, static_argnums=2)
    def run(state, dt, n):
        out = li.integrate(STEP, state, dt, n)
        return jax.tree.map(lambda x: x[-1], out.state), jnp.max(jnp.abs(jax.vmap(BODY.volume_rate)(out.state)))

    exact = jax.jit(flow, static_argnums=(0, 3))(BODY, STATE, 0.32, 32)
    assert abs(np.linalg.det(exact.q) - 1) < 4e-15
    assert abs(BODY.volume_rate(exact)) < 4e-15
    assert float(BODY.energy(exact)) == pytest.approx(float(BODY.energy(STATE)), rel=1e-14, abs=1e-12)
    errors, rates = [], []
    for n in (16, 32):
        end, rate = run(STATE, 0.32 / n, n)
        errors.append(np.abs(end.q - exact.q).max())
        rates.append(rate)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)
    assert np.log2(rates[0] / rates[1]) == pytest.approx(2, abs=0.1)
    back = once(STEP, once(STEP, STATE, DT)[0], -DT)[0]
    np.testing.assert_allclose(back.q, STATE.q, rtol=0, atol=4e-15)
    assert np.abs(BODY.volume_rate(STATE)) < 1e-15


@pytest.mark.quick
def test_the_vector_field_is_hamiltonian_and_perturb_stays_on_the_manifold():
    """i_X ω = dH on T*SL(3), and X is tangent to it; det F = 1 and tr(ḞF⁻¹) = 0 after a perturbation."""
    space = BODY.phase_space

    @functools.partial(jax.jit, compiler_options=QUICK)
    def everything(state):
        slope = jax.grad(lambda x: BODY.energy(space.perturb(state, x)))(jnp.zeros(16))
        tangents = jax.jacfwd(lambda x: space.perturb(state, x))(jnp.zeros(16))
        one = jax.vmap(lambda t: space.trivialize(state, t), in_axes=-1, out_axes=-1)(tangents)
        moved = space.perturb(state, 0.1 * jnp.sin(jnp.arange(16.0)))
        field = space.trivialize(state, BODY.vector_field(state))
        drift = jax.jvp(BODY.volume_rate, (state,), (BODY.vector_field(state),))[1]
        return space.omega(state).T @ field, slope, one, space.defect(moved), BODY.volume_rate(moved), drift

    left, slope, one, volume, rate, drift = everything(STATE)
    np.testing.assert_allclose(left, slope, rtol=0, atol=2e-13)  # of numbers up to 40
    assert np.abs(slope).max() > 1
    np.testing.assert_allclose(one, np.eye(16), rtol=0, atol=1e-14)
    assert abs(volume) < 1e-14
    assert abs(rate) < 1e-14
    assert abs(drift) < 2e-15  # observed: 3e-16; the pressure keeps tr(ḞF⁻¹) at 0


def test_an_incompressible_body_is_the_limit_of_stiff_ones():
    """The flow of W + (λ/2)(I₃ − 1 − ln I₃) tends to the constrained one: it is off by less than 1/λ."""
    exact = jax.jit(flow, static_argnums=(0, 3))(BODY, STATE, 0.4, 40)
    for lam in (1e4, 1e5):
        stiff = li.systems.pseudo_rigid_body(BODY.inertia, li.systems.mooney_rivlin(lam, 6.0))
        far = np.abs(jax.jit(flow, static_argnums=(0, 3))(stiff, STATE, 0.4, 2000).q - exact.q).max()
        assert 0.05 < lam * far < 1  # 0.68 and 0.26, by the phase of the fast oscillation


def test_the_certificate_shows_energy_momentum_and_volume_conserved():
    found = li.diagnostics.certify(STEP, STATE, DT, 500)
    assert found.converged
    assert max(found.energy, found.momentum, found.constraint) < 2e-14  # floors 6e-15, 3e-15, 4e-16
    assert found.order == pytest.approx(2, abs=0.02)
    assert found.symplectic_order == pytest.approx(3, abs=0.1)  # not symplectic
    assert found.reversibility < 2e-14


def test_a_step_of_no_time_leaves_the_momentum():
    still, info = once(STEP, STATE, 0.0)
    assert info.converged
    np.testing.assert_allclose(still.p, STATE.p, rtol=0, atol=1e-15)
