"""The free rigid body: the ways to give a state and to read it, its equations, and what bad input gets."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import Q, moving, turned

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
    assert BODY.energy(state) == pytest.approx(float(OMEGA @ Pi / 2), rel=1e-15)
    identity = BODY.state(angular_velocity=OMEGA)
    np.testing.assert_array_equal(identity.q, so3.identity)


@pytest.mark.long
@pytest.mark.paper("2.1: (2.11)–(2.13)", "the free rigid body", "systems/_rigid_body.py")
def test_vector_field_is_hamiltonian_for_the_form_2_9():
    """ω(X, ·) = dH in the spatial trivialization, for a full inertia tensor."""
    body = li.systems.rigid_body(turned([1.0, 2.0, 3.0]))
    space = body.phase_space

    @jax.jit
    def sides(state):
        X = space.trivialize(state, body.vector_field(state))
        return X @ space.omega(state), jax.grad(lambda d: body.energy(space.perturb(state, d)))(jnp.zeros(6))

    np.testing.assert_allclose(*sides(moving(body.inertia, OMEGA)), rtol=0, atol=4e-15)


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


BAD_INERTIA = {
    "positive definite": ([1.0, 2.0, -3.0], [[1.0, 2, 0], [2, 1, 0], [0, 0, 1]], [0.0, 1.0, 1.0]),
    "symmetric": ([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]],),
    "finite": ([1.0, np.nan, 1.0], [1.0, np.inf, 1.0]),
    r"shape \(3,\) or \(3, 3\)": ([1.0, 2.0], 3.0, np.ones((2, 3))),
    "real numbers": (["one", "two", "three"], [1j, 1, 1], None, [[1, 2], [3]]),
}


@pytest.mark.parametrize(("message", "value"), [(m, v) for m, values in BAD_INERTIA.items() for v in values])
def test_a_bad_inertia_is_refused(message, value):
    with pytest.raises(ValueError, match=message):
        li.systems.rigid_body(value)


def test_pseudo_inertia_warns_and_is_not_refused():
    with pytest.warns(UserWarning, match="triangle inequality"):
        assert li.systems.rigid_body([1.0, 1.0, 3.0]).inertia.shape == (3,)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        li.systems.rigid_body([1.0, 1.0, 2.0])  # a flat body is on the boundary, and fine
        li.systems.rigid_body([1, 2, 3])  # integers are real numbers


BAD_ATTITUDE = {
    "unit quaternion": ([1.0, 0, 0, 2e-2], [0.0, 0, 0, 0], [1.0002, 0, 0, 0]),
    "orthogonal": (np.eye(3) * 1.001, np.ones((3, 3))),
    "reflection": (np.diag([1.0, 1, -1]),),
    "finite": ([np.nan, 0, 0, 0], np.full((3, 3), np.inf)),
    r"quaternion \(w, x, y, z\), shape \(4,\), or a rotation matrix \(3, 3\)": ([1.0, 0, 0], np.eye(4)),
}


@pytest.mark.parametrize(("message", "value"), [(m, v) for m, values in BAD_ATTITUDE.items() for v in values])
def test_a_bad_attitude_is_refused(message, value):
    with pytest.raises(ValueError, match=message):
        BODY.state(value, angular_velocity=OMEGA)


def test_a_quaternion_nearly_of_unit_length_is_normalized():
    state = BODY.state([1.0 + 5e-7, 0, 0, 0], angular_velocity=OMEGA)
    assert state.q[0] == 1
    with pytest.warns(RuntimeWarning, match=r"attitude has the norm 1\.00001, .*few digits have: normalized"):
        assert BODY.state([1.00001, 0, 0, 0], angular_velocity=OMEGA).q[0] == 1


def test_numbers_beyond_the_range_of_floats_are_refused():
    with pytest.raises(ValueError, match="real numbers"):
        BODY.state(Q, angular_velocity=10**400)
    with pytest.raises(ValueError, match="spatial momentum must be finite"):
        BODY.state(Q, angular_velocity=[1e308, 1e308, 1e308])


def test_a_state_requires_exactly_one_kind_of_motion():
    for given in ({}, {"angular_velocity": OMEGA, "body_momentum": OMEGA}):
        with pytest.raises(ValueError, match="exactly one of angular_velocity"):
            BODY.state(Q, **given)
    with pytest.raises(ValueError, match=r"angular_velocity must have shape \(3,\).*jax.vmap"):
        BODY.state(Q, angular_velocity=np.ones((2, 3)))
