"""The explicit form of the symplectic step: equal to the implicit one, solved once, and honest about what it is for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import moving, turned
from linearized import there_and_back

import lieint_jax as li
from lieint_jax.core.tangent import distance
from lieint_jax.schemes import so3_explicit, so3_midpoint
from lieint_jax.systems import RigidBody

INERTIAS = {"principal": jnp.array([1.0, 2.0, 3.0]), "full": turned([1.0, 2.0, 2.5])}


@jax.jit
def measured(body, state):
    """Of 2000 steps of 0.1 and of −0.7 what is kept, and how far the two forms are from each other in the first 200.

    Of a step of 0.4: the form, and the way back.
    """
    explicit, implicit = so3_explicit(body), so3_midpoint(body, iterations=4)

    def both(dt):
        one, other = (li.integrate(step, state, dt, 2000) for step in (explicit, implicit))
        return {
            "converged": one.info.converged,
            "apart": (one.state.q - other.state.q)[:201],
            "energy": li.Run.of(explicit, one).energy_error() / body.energy(state),
            "momentum": li.Run.of(explicit, one).momentum_error(),
        }

    _, _, form, back = there_and_back(explicit, state, 0.4)
    return jax.lax.map(both, jnp.array([0.1, -0.7])), form, distance(back, state)


@pytest.mark.slow
@pytest.mark.parametrize("name", INERTIAS)
def test_so3_explicit_is_the_implicit_step_and_conserves_as_much(name):
    runs, form, back = measured(RigidBody(INERTIAS[name]), moving(INERTIAS[name]))
    assert runs["converged"].shape == (2, 2001)
    assert runs["converged"].all()
    assert np.abs(runs["apart"]).max() < 3e-13  # floor 4e-14
    assert np.abs(runs["energy"]).max() < 8e-15  # floor 2e-15
    assert np.abs(runs["momentum"]).max() == 0
    assert form < 5e-15
    assert back < 2e-15


@pytest.mark.long
def test_an_ensemble_prepares_every_member_and_every_inertia():
    J = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 2.0]])
    states = [moving(*pair) for pair in zip(J, ([0.3, 0.6, 0.8], [1, 0, 0.2]), strict=True)]
    states = jax.tree.map(lambda *x: jnp.array(np.stack(x)), *states)
    bodies = jax.vmap(RigidBody)(J)
    found = li.run(so3_explicit(bodies), states, 0.2, 100, own_step=True, progress=False, save_every=None)
    expected = li.run(so3_midpoint(bodies), states, 0.2, 100, own_step=True, progress=False, save_every=None)
    assert np.abs(np.asarray(found.state.q) - expected.state.q).max() < 1e-13


@pytest.mark.long
def test_a_step_prepared_for_another_run_does_not_converge():
    body = RigidBody(INERTIAS["principal"])
    state = moving(body.inertia)
    step = so3_explicit(body).prepare(state, 0.4)
    assert step(state, -0.4)[1].converged
    assert not step(state, 0.3)[1].converged
    assert not step(state._replace(p=state.p * (1 + 1e-6)), 0.4)[1].converged
    assert "prepared for another trajectory" in step.advice(state, 0.3)
    with pytest.raises(ValueError, match="does not converge"):
        li.integrate(so3_explicit(body), state, 2.0, 1)
    assert not so3_explicit(body)(state._replace(p=state.p * jnp.nan), 0.4)[1].converged


def test_a_failure_is_reported_by_its_own_name_without_advice_that_it_cannot_follow():
    body = RigidBody(INERTIAS["principal"])
    advice = so3_explicit(body).advice(moving(body.inertia), 3.0)
    assert advice.startswith("so3_explicit does not converge: |Δt Ω| = ")
    assert "so3_midpoint[" not in advice
    assert "more iterations" not in so3_explicit(body).advice(moving(body.inertia), 0.1)
    assert "more iterations than 3" in so3_midpoint(body).advice(moving(body.inertia), 0.1)
