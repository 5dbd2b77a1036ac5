"""SO(3): group axioms, maps against matrices and mpmath, derivatives at 0 and near π, on random and chosen elements."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest

from lieint_jax.groups import so3

EPS = np.finfo(float).eps
coordinate = st.floats(-3, 3, allow_nan=False, width=64)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
units = st.tuples(*[st.floats(-1, 1, width=64)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)
units = units.map(lambda q: q / np.linalg.norm(q))


def same(a, b, bound=4 * EPS):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=0, atol=bound)


EXP, LOG, MUL, INVERSE = map(jax.jit, (so3.exp, so3.log, so3.multiply, so3.inverse))
AD, AD_STAR, MATRIX, DEFECT = map(jax.jit, (so3.Ad, so3.Ad_star, so3.to_matrix, so3.defect))
EULER, FROM_EULER = map(jax.jit, (so3.to_euler_313, so3.from_euler_313))


@pytest.mark.long
@hypothesis.given(units, units, units)
def test_quaternions_satisfy_the_group_axioms(a, b, c):
    same(MUL(MUL(a, b), c), MUL(a, MUL(b, c)))
    same(MUL(a, so3.identity), a)
    same(MUL(a, INVERSE(a)), so3.identity)
    assert abs(DEFECT(MUL(a, b))) < 8 * EPS


@hypothesis.given(units, units, vectors, vectors)
def test_Ad_is_the_rotation_matrix_and_a_homomorphism(a, b, u, v):
    R = np.array(MATRIX(a))
    same(R.T @ R, np.eye(3), 32 * EPS)
    same(AD(a, u), R @ u, 32 * EPS)
    same(AD_STAR(a, u), R.T @ u, 32 * EPS)
    same(AD(MUL(a, b), u), AD(a, AD(b, u)), 64 * EPS)
    same(np.dot(AD_STAR(a, u), v), np.dot(u, AD(a, v)), 128 * EPS)


@jax.jit
def _algebra(u, v, w):
    ad = so3.ad
    jacobi = ad(u, ad(v, w)) + ad(v, ad(w, u)) + ad(w, ad(u, v))
    return so3.hat(u), so3.vee(so3.hat(u)), ad(u, v), so3.ad_star(u, v), ad(u, w), jacobi


@hypothesis.given(vectors, vectors, vectors)
def test_hat_vee_and_brackets_satisfy_the_algebra(u, v, w):
    hat, back, ad, dual, paired, jacobi = map(np.asarray, _algebra(u, v, w))
    same(ad, np.cross(u, v), 8 * EPS)
    same(hat @ v, np.cross(u, v), 8 * EPS)
    same(back, u, 1e-300)  # but for numbers that are flushed to 0
    same(np.dot(dual, w), np.dot(v, paired), 256 * EPS)
    same(jacobi, 0, 256 * EPS)


@hypothesis.given(vectors)
def test_exp_against_the_matrix_and_log_inverts_it(v):
    q = EXP(v)
    if np.linalg.norm(v) > 1e-3:
        same(MATRIX(q), paper.exp(v), 32 * EPS)
    angle = np.linalg.norm(v)
    wrapped = v if angle <= np.pi else v * (1 - 2 * np.pi / angle)
    same(LOG(q), wrapped, 64 * EPS)


@jax.jit
def _exp_and_log(v):
    """log exp v and its derivative; the derivative of exp, left-trivialized; and its second derivative."""
    both = lambda v: so3.log(so3.exp(v))  # noqa: E731
    first = jax.jacfwd(so3.exp)
    H = jax.vmap(lambda t: so3.body_velocity(so3.exp(v), t), in_axes=-1, out_axes=-1)(first(v))
    return both(v), jax.jacfwd(both)(v), H, jax.jacfwd(first)(v)


@pytest.mark.long
@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-9, 1e-4, 0.19999, 0.2, 1.0, 1.99, 2.0, 2.01, 3.1, 3.1415926])
def test_exp_and_log_and_their_derivatives_at_every_size(angle):
    """Right up to both sides of every series threshold: values, and D log ∘ D exp = 1."""
    axis = np.array([0.6, -0.48, 0.64])
    v = axis * angle
    back, D, H, second = _exp_and_log(v)
    same(back, v, 8 * EPS)
    same(D, np.eye(3), 1e-13 if angle < 3 else 1e-7)
    a, b = (1.0, 0.0) if angle == 0 else (np.sin(angle) / angle, 2 * np.sin(angle / 2) ** 2 / angle)
    u = np.array(paper.hat(axis))
    same(H, np.eye(3) + (a - 1) * (-u @ u) - b * u, 1e-15)  # left-trivialized derivative of exp
    assert np.isfinite(second).all()


@pytest.mark.long
def test_second_derivative_of_exp_at_zero():
    """exp(v) = 1 + v/2 − |v|²/8 + …"""
    second = np.asarray(jax.jit(jax.jacfwd(jax.jacrev(so3.exp)))(np.zeros(3)))
    same(second[0], -np.eye(3) / 4)
    same(second[1:], 0)


@jax.jit
def _by_matrix(v):
    """The rest of exp v after a way through its matrix, and the derivative of that way at exp v, in space."""
    q = so3.exp(v)
    way = lambda q: so3.from_matrix(so3.to_matrix(q))  # noqa: E731
    back = way(q)
    D = jax.jacfwd(lambda v: way(so3.multiply(so3.exp(v), q)))(jnp.zeros(3))
    velocity = jax.vmap(lambda t: so3.spatial_velocity(back, t), in_axes=-1, out_axes=-1)(D)
    return so3.multiply(so3.inverse(back), q), velocity


@pytest.mark.long
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-9, np.pi - 1e-4, 3.0, 1e-9, 0.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0), (0.6, -0.48, 0.64)])
def test_quaternion_of_a_matrix_near_half_turns(axis, angle):
    rest, velocity = map(np.asarray, _by_matrix(np.array(axis, float) * angle))
    same(rest[1:], 0)
    same(velocity, np.eye(3), 16 * EPS)


@hypothesis.given(st.floats(-3, 3), st.floats(0.01, 3.13), st.floats(-3, 3))
def test_euler_angles_are_inverted_by_their_attitude(alpha, beta, gamma):
    angles = np.array([alpha, beta, gamma])
    same(EULER(FROM_EULER(angles)), angles, 2e-13)  # sin β down to 0.01 divides the round-off


@hypothesis.given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_euler_angles_are_z_x_z(alpha, beta, gamma):
    def turn(axis, angle):
        return paper.exp(np.eye(3)[axis] * angle) if abs(angle) > 1e-100 else np.eye(3)

    R = turn(2, alpha) @ turn(0, beta) @ turn(2, gamma)
    same(MATRIX(FROM_EULER(np.array([alpha, beta, gamma]))), R, 16 * EPS)


@pytest.mark.parametrize("beta", [0.0, np.pi])
def test_euler_angles_at_the_lock_give_the_attitude_back(beta):

    @jax.jit
    def there_and_back(angles):
        q = so3.from_euler_313(angles)
        again = so3.from_euler_313(so3.to_euler_313(q))
        return so3.angle(q, again), jax.jacfwd(so3.to_euler_313)(q)

    turned, slope = there_and_back(np.array([0.7, beta, 0.4]))
    assert turned < 8 * EPS
    assert np.isfinite(slope).all()


@jax.jit
def _velocities(q, v):
    """q̇ of q exp(tv); its velocity in the body and in space; what they should be; q̇ by the one and by the other."""
    q_dot = jax.jvp(lambda t: so3.multiply(q, so3.exp(t * v)), (0.0,), (1.0,))[1]
    body, space, carried = so3.body_velocity(q, q_dot), so3.spatial_velocity(q, q_dot), so3.Ad(q, v)
    return q_dot, body, space, carried, so3.tangent(q, v), so3.spatial_tangent(q, carried)


@pytest.mark.paper("2.1: (2.1), (2.2), (2.10)", "algebra, velocities", "groups/so3.py")
@hypothesis.given(units, vectors)
def test_velocities_in_body_and_space_are_consistent(q, v):
    q_dot, body, space, carried, tangent, spatial_tangent = map(np.asarray, _velocities(q, v))
    same(body, v, 32 * EPS)
    same(space, carried, 64 * EPS)
    same(tangent, q_dot, 8 * EPS)
    same(spatial_tangent, q_dot, 32 * EPS)


@jax.jit
def _increment(q, h):
    """By `cayley_increment` and by the product."""
    return so3.cayley_increment(q, h), so3.multiply(q, so3.cayley(2 * h))


@hypothesis.given(units, vectors)
def test_cayley_increment_is_the_product(q, h):
    same(*_increment(q, h), 8 * EPS)


def test_cayley_increment_corrects_the_norm():
    q = np.array([1.0, 2, -2, 4]) / 5 * (1 + 1e-9)
    assert abs(DEFECT(_increment(q, np.array([0.1, 0.2, 0.3]))[0])) < 4 * EPS


def test_angle_has_no_nan_gradient_where_it_vanishes():
    """It is the natural loss of an attitude fit, and zero at its minimum."""
    gradient = jax.jit(jax.grad(lambda v: so3.angle(jnp.array(so3.identity), so3.exp(v))))
    np.testing.assert_array_equal(gradient(np.zeros(3)), 0)
    np.testing.assert_allclose(gradient(np.array([0.0, 1e-8, 0.0])), [0, 1, 0], rtol=0, atol=1e-12)


@jax.jit
def _turned(q, v):
    """The angle from q to q exp v, and log exp v."""
    turn = so3.exp(v)
    return so3.angle(q, so3.multiply(q, turn)), so3.log(turn)


@hypothesis.given(units, vectors)
def test_angle_is_the_length_of_the_logarithm(q, v):
    angle, log = map(np.asarray, _turned(q, v))
    same(angle, np.linalg.norm(log), 64 * EPS)


@pytest.mark.long
def test_euler_angles_where_only_a_sum_is_determined():
    """They give the same attitude again, with finite derivatives."""
    for sequence, middle in (("ZXZ", 0.0), ("zyz", np.pi), ("ZYX", np.pi / 2), ("xyz", -np.pi / 2)):
        q = so3.from_euler(jnp.array([0.4, middle, 0.3]), sequence)
        again = so3.from_euler(so3.to_euler(q, sequence), sequence)
        assert abs(float(q @ again)) == pytest.approx(1, abs=1e-14)
        assert np.isfinite(jax.jacfwd(lambda q, s=sequence: so3.to_euler(q, s))(q)).all()


def test_a_scipy_rotation_is_an_attitude():
    """Recognized by its methods; scipy puts the scalar part last."""
    from scipy.spatial.transform import Rotation

    import lieint_jax as li

    turn = Rotation.from_euler("ZXZ", [0.3, 0.5, -0.2])
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    same(body.rotation_matrix(body.state(turn, angular_velocity=[0.0, 0, 1])), turn.as_matrix())
    several = Rotation.from_euler("ZXZ", [[0.3, 0.5, -0.2], [1.0, 0.2, 0.4]])
    two = li.systems.rigid_bodies([1.0, 2.0], [[1.0, 2, 2.5]] * 2, li.potentials.point_masses(1.0, [1.0, 2.0]))
    same(two.state([[0.0, 0, 0], [3.0, 0, 0]], several).q[:, 3:], np.roll(several.as_quat(), 1, axis=1))


@pytest.mark.parametrize("turned", [so3.cayley_increment, so3.exp_increment], ids=["cay", "exp"])
def test_turned_quaternions_are_no_longer_than_one_in_the_mean(turned):
    """|q|² − 1 is 0.36 eps in size, and its mean 0 ± 2e-4 eps; 0.054 if |q|² is rounded before 1 is subtracted."""
    rng = np.random.default_rng(0)
    q = rng.normal(size=(100_000, 4))
    q = jnp.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
    turn = jax.jit(jax.vmap(turned))
    means = []
    for _ in range(30):
        q = turn(q, jnp.asarray(1e-3 * rng.normal(size=(100_000, 3))))
        means.append(float(np.mean(np.sum(np.asarray(q, np.longdouble) ** 2, axis=1) - 1)))
    assert abs(np.mean(means[10:])) < 0.003 * np.finfo(float).eps
