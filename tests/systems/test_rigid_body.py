"""The free rigid body: the ways to give a state and to read it, its equations, and what bad input gets."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import Q, moving

import lieint_jax as li
from lieint_jax.groups import so3

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
OMEGA = jnp.array([0.3, -0.5, 0.8])


def test_every_way_to_give_a_state_and_to_read_it():
    R = so3.to_matrix(Q)
    state = BODY.state(Q, angular_velocity=OMEGA)
    Pi = BODY.inertia * OMEGA
    for other in (
        BODY.state(R, angular_velocity=OMEGA),
        BODY.state(Q, body_momentum=Pi),
        BODY.state(Q, spatial_momentum=R @ Pi),
    ):
        assert so3.angle(other.q, state.q) < 1e-15
        np.testing.assert_allclose(other.p, state.p, rtol=0, atol=6e-15)
    np.testing.assert_allclose(BODY.rotation_matrix(state), R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(BODY.body_momentum(state), Pi, rtol=0, atol=6e-15)
    np.testing.assert_allclose(BODY.angular_velocity(state), OMEGA, rtol=0, atol=1e-15)
    np.testing.assert_allclose(BODY.momentum(state), R @ Pi, rtol=0, atol=6e-15)
    assert BODY.energy(state) == pytest.approx(float(OMEGA @ Pi / 2), rel=3e-15, abs=0)
    identity = BODY.state(angular_velocity=OMEGA)
    np.testing.assert_array_equal(identity.q, so3.identity)


def test_trivialize_inverts_perturb():
    space, delta = BODY.phase_space, np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])

    @jax.jit
    def there_and_back(state, delta):
        return space.trivialize(state, jax.jvp(lambda s: space.perturb(state, s * delta), (0.0,), (1.0,))[1])

    np.testing.assert_allclose(there_and_back(moving(BODY.inertia, OMEGA), delta), delta, rtol=0, atol=1e-15)
    assert space.dim == 6


def test_the_constructors_of_a_rigid_body_vmap_and_differentiate():
    energy = lambda J, q: li.systems.rigid_body(J).state(q, angular_velocity=OMEGA).p.sum()  # noqa: E731
    assert jax.jit(jax.vmap(energy, in_axes=(0, None)))(np.ones((3, 3)), Q).shape == (3,)
    assert np.isfinite(jax.jit(jax.grad(energy))(np.eye(3), Q)).all()


def test_pseudo_inertia_warns_and_is_not_refused():
    with pytest.warns(UserWarning, match="triangle inequality"):
        assert li.systems.rigid_body([1.0, 1.0, 3.0]).inertia.shape == (3,)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        li.systems.rigid_body([1.0, 1.0, 2.0])  # a flat body is on the boundary, and fine
        li.systems.rigid_body([1, 2, 3])  # integers are real numbers


def test_a_quaternion_nearly_of_unit_length_is_normalized():
    state = BODY.state([1.0 + 5e-7, 0, 0, 0], angular_velocity=OMEGA)
    assert state.q[0] == 1
    with pytest.warns(RuntimeWarning, match=r"attitude has the norm 1\.00001, .*few digits have: normalized"):
        assert BODY.state([1.00001, 0, 0, 0], angular_velocity=OMEGA).q[0] == 1
