"""Preprocessed inertia: the order rises; energy, momentum and the reduced structure stay; the form does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.groups import so3
from lieint_jax.schemes import preprocessed, so3_midpoint

TURN = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
BODIES = {
    "principal": li.systems.rigid_body([1.0, 2.0, 3.0]),
    "full": li.systems.rigid_body(TURN @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ TURN.T),
    "large": li.systems.rigid_body([1e20, 2e20, 2.5e20]),
}


def setting(body):
    state = body.state(so3.normalise(jnp.array([1.0, 2, -1, 0.5])), angular_velocity=[0.3, 0.6, 0.8])
    return state, diagnostics.flow(body, state, 3.2, 16)


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("name", BODIES)
def test_order_against_the_exact_flow(name, order):
    body = BODIES[name]
    state, end = setting(body)
    step = preprocessed(body, order)
    runs = [li.integrate(step, state, 3.2 / n, n, n) for n in (8, 16)]
    errors = [float(so3.angle(run.state.q[-1], end.q)) for run in runs]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)
    base = li.integrate(so3_midpoint(body), state, 0.2, 16, 16)
    assert errors[1] < 1e-2 * float(so3.angle(base.state.q[-1], end.q))


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("name", BODIES)
def test_energy_momentum_and_symmetry_are_exact(name, order):
    body = BODIES[name]
    state, _ = setting(body)
    step = preprocessed(body, order)
    run = li.integrate(step, state, 0.4, 500)
    assert run.info.converged.all()
    assert np.abs(diagnostics.energy_error(body, run) / body.energy(state)).max() < 1e-14  # floor 3e-15
    assert np.abs(diagnostics.momentum_error(body, run)).max() == 0
    assert diagnostics.reversibility(step, state, 0.4) < 1e-15 * max(1, float(jnp.abs(state.p).max()))


@pytest.mark.parametrize("order", [4, 6])
def test_reduced_lie_poisson_structure_is_exact_and_the_canonical_form_is_not(order):
    """The map of Π alone is Poisson, DΠ̂₀Dᵀ = Π̂₁, to round-off; on T*SO(3) the defect is O(Δt^{order+1})."""
    body = BODIES["full"]
    state, _ = setting(body)
    step = preprocessed(body, order)

    def reduced(Pi):
        return body.body_momentum(step(body.state(body_momentum=Pi), 0.4)[0])

    Pi = body.body_momentum(state)
    D = jax.jacfwd(reduced)(Pi)
    assert np.abs(D @ so3.hat(Pi) @ D.T - so3.hat(reduced(Pi))).max() < 8e-15  # floor 2e-15
    coarse, fine = (float(diagnostics.symplectic_defect(step, state, dt)) for dt in (0.4, 0.2))
    assert coarse > 1e-6
    assert np.log2(coarse / fine) == pytest.approx(order + 1, abs=0.15)


def test_the_literature_s_number():
    """4.2e-7 at Δt = .1, order 4, is the size of the canonical defect."""
    body = BODIES["principal"]
    defect = diagnostics.symplectic_defect(preprocessed(body, 4), setting(body)[0], 0.1)
    assert 1e-8 < defect < 1e-6


def test_derivatives_and_batches():
    state, _ = setting(BODIES["principal"])

    def end(J, dt):
        return preprocessed(li.systems.RigidBody(J), 6)(state, dt)[0].q[1]

    J = BODIES["principal"].inertia
    gradient = jax.jit(jax.grad(end, argnums=(0, 1)))(J, 0.3)
    h = 1e-6
    for k, e in enumerate(np.eye(3)):
        assert gradient[0][k] == pytest.approx(float(end(J + h * e, 0.3) - end(J - h * e, 0.3)) / (2 * h), rel=1e-7)
    assert gradient[1] == pytest.approx(float(end(J, 0.3 + h) - end(J, 0.3 - h)) / (2 * h), rel=1e-7)
    assert jax.vmap(end, in_axes=(None, 0))(J, jnp.array([0.1, -0.1])).shape == (2,)


def test_bad_arguments():
    body = BODIES["principal"]
    with pytest.raises(ValueError, match="order must be 4 or 6, got 8"):
        preprocessed(body, 8)
    with pytest.raises(ValueError, match="free rigid bodies"):
        preprocessed("top", 4)
    for iterations in (0, -1, 2.5):
        with pytest.raises(ValueError, match="iterations must be an integer ≥ 1"):
            preprocessed(body, 4, iterations)
    state, _ = setting(body)
    with pytest.raises(ValueError, match=r"preprocessed\[4\] takes the step of another inertia; .*does not converge"):
        li.integrate(preprocessed(body, 4), state, 3.0, 1)
