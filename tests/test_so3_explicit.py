"""The explicit form of the symplectic step: equal to the implicit one, solved once, and honest about what it is for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics, ensemble
from lieint_jax.groups import so3
from lieint_jax.schemes import so3_explicit, so3_midpoint
from lieint_jax.systems import RigidBody

Q = so3.normalise(jnp.array([1.0, 2, -1, 0.5]))
TURN = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
INERTIAS = {"principal": jnp.array([1.0, 2.0, 3.0]), "full": TURN @ jnp.diag(jnp.array([1.0, 2.0, 2.5])) @ TURN.T}
run = jax.jit(li.integrate, static_argnums=(3, 4))


@pytest.mark.parametrize("name", INERTIAS)
def test_equal_to_the_implicit_step_and_as_conserving(name):
    body = RigidBody(INERTIAS[name])
    state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
    for dt in (0.1, -0.7):
        one, other = (run(step, state, dt, 200, 1) for step in (so3_explicit(body), so3_midpoint(body, iterations=4)))
        assert one.info.converged.all()
        assert np.abs(one.state.q - other.state.q).max() < 3e-13  # floor 4e-14
        assert np.abs(diagnostics.energy_error(body, one) / body.energy(state)).max() < 8e-15  # floor 2e-15
        assert np.abs(diagnostics.momentum_error(body, one)).max() == 0
    assert diagnostics.symplectic_defect(so3_explicit(body), state, 0.4) < 5e-15
    assert diagnostics.reversibility(so3_explicit(body), state, 0.4) < 2e-15


def test_gradients_go_through_what_is_solved_once():
    state = RigidBody(INERTIAS["principal"]).state(Q, angular_velocity=[0.3, 0.6, 0.8])

    def end(make, J, dt):
        return li.integrate(make(RigidBody(J)), state, dt, 10, 10).state.q[-1, 1]

    found = jax.grad(lambda J, dt: end(so3_explicit, J, dt), argnums=(0, 1))(INERTIAS["principal"], 0.2)
    expected = jax.grad(lambda J, dt: end(so3_midpoint, J, dt), argnums=(0, 1))(INERTIAS["principal"], 0.2)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_an_ensemble_prepares_every_member_and_every_inertia():
    J = jnp.array([[1.0, 2.0, 3.0], [1.0, 1.0, 2.0]])
    states = jax.vmap(lambda J, w: RigidBody(J).state(Q, angular_velocity=w))(
        J, jnp.array([[0.3, 0.6, 0.8], [1, 0, 0.2]])
    )
    found = ensemble.run(so3_explicit(RigidBody(J)), states, 0.2, 100, step_axis=0, progress=False)
    expected = ensemble.run(so3_midpoint(RigidBody(J)), states, 0.2, 100, step_axis=0, progress=False)
    assert np.abs(found.state.q - expected.state.q).max() < 1e-13


def test_what_it_was_not_prepared_for_is_told():
    body = RigidBody(INERTIAS["principal"])
    state = body.state(Q, angular_velocity=[0.3, 0.6, 0.8])
    step = so3_explicit(body).prepare(state, 0.4)
    assert step(state, -0.4)[1].converged
    assert not step(state, 0.3)[1].converged
    assert not step(state._replace(p=state.p * (1 + 1e-6)), 0.4)[1].converged
    assert "prepared for another trajectory" in step.advice(state, 0.3)
    with pytest.raises(ValueError, match="does not converge"):
        li.integrate(so3_explicit(body), state, 2.0, 1)
    with pytest.raises(ValueError, match="free rigid bodies"):
        so3_explicit("top")
    assert not so3_explicit(body)(state._replace(p=state.p * jnp.nan), 0.4)[1].converged
