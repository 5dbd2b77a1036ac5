"""Attitudes of other conventions against scipy, MuJoCo, SPICE and the formulas of books; derivatives at half turns."""

import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import slopes
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import attitude
from lieint_jax.groups import so3

SEQUENCES = ["".join(s) for s in itertools.product("xyz", repeat=3) if s[0] != s[1] != s[2]]
SEQUENCES += [s.upper() for s in SEQUENCES]
FLOOR = 9e-16  # observed: 3.3e-16 of matrices, 8.9e-16 of angles up to π, of 10 000 random attitudes
units = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)
units = units.map(lambda q: q / np.linalg.norm(q))
PAIRS = {
    "scalar_first": (attitude.from_scalar_first, attitude.to_scalar_first, lambda r: np.roll(r.as_quat(), 1)),
    "scalar_last": (attitude.from_scalar_last, attitude.to_scalar_last, lambda r: r.as_quat()),
    "mrp": (attitude.from_mrp, attitude.to_mrp, lambda r: r.as_mrp()),
    "matrix": (attitude.from_matrix, attitude.to_matrix, lambda r: r.as_matrix()),
    "rotvec": (attitude.from_rotvec, attitude.to_rotvec, lambda r: r.as_rotvec()),
    **{
        name: (
            lambda x, frame="body_to_space", name=name: attitude.from_euler(name, x, frame),
            lambda q, frame="body_to_space", name=name: attitude.to_euler(name, q, frame),
            lambda r, name=name: r.as_euler(name),
        )
        for name in ("ZYX", "zxz")
    },
}


def distance(a, b):
    """Of unit quaternions, whatever their signs."""
    a, b = np.asarray(a), np.asarray(b)
    return np.max(np.abs(a * np.sign(np.sum(a * b, axis=-1, keepdims=True)) - b))


@pytest.mark.parametrize("name", PAIRS)
@given(units)
def test_every_form_is_that_of_scipy_in_both_frames(name, q):
    there, back, of_scipy = PAIRS[name]
    r = Rotation.from_quat(np.roll(q, -1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scipy, at gimbal lock
        numbers, inverse = of_scipy(r), of_scipy(r.inv())
    if name not in ("ZYX", "zxz") or abs(np.sin(2 * numbers[1] if name == "ZYX" else numbers[1])) > 1e-3:
        assert distance(there(numbers), q) <= 2 * FLOOR
        assert distance(there(inverse, frame="space_to_body"), q) <= 2 * FLOOR
    for frame in ("body_to_space", "space_to_body"):
        assert distance(there(back(q, frame=frame), frame=frame), q) <= 2 * FLOOR
    if name == "matrix":
        np.testing.assert_allclose(back(q), numbers, rtol=0, atol=FLOOR)
    if name == "mrp" and abs(q[0]) > 1e-3:
        np.testing.assert_allclose(back(-q), numbers, rtol=0, atol=FLOOR)
        assert distance(there(-numbers / max(numbers @ numbers, 1e-200)), q) <= 2 * FLOOR or not numbers.any()


@pytest.mark.long
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_all_conventions_of_euler_angles_are_those_of_scipy(sequence):
    r = Rotation.random(200, rng=1)
    q, angles = np.roll(r.as_quat(), 1, axis=1), r.as_euler(sequence)
    assert distance(attitude.from_euler(sequence, angles), q) <= FLOOR
    off = np.asarray(attitude.to_euler(sequence, q)) - angles
    assert np.max(np.abs((off + np.pi) % (2 * np.pi) - np.pi)) <= 40 * FLOOR  # the second angle divides by its sine


HALF_TURN = np.array([0.0, 0.6, -0.48, 0.64])
PLACES = {
    "identity": np.eye(4)[0],
    "half a turn": HALF_TURN,
    "half a turn about x": np.eye(4)[1],
    "elsewhere": np.array([0.5, 0.1, -0.7, 0.5]),
}


@jax.jit
def forms_and_back(q, v):
    """All forms of q exp v, (…,), and log of q⁻¹ and the ways there and back, (forms, 3)."""
    near = so3.multiply(q, so3.exp(v))
    forms = {name: back(near) for name, (_, back, _) in PAIRS.items()}
    spins = {name: so3.log(so3.multiply(so3.inverse(q), PAIRS[name][0](form))) for name, form in forms.items()}
    return {name: jnp.concatenate([jnp.ravel(form), spins[name]]) for name, form in forms.items()}


derivatives = {"forward": jax.jit(jax.jacfwd(forms_and_back, 1)), "reverse": jax.jit(jax.jacrev(forms_and_back, 1))}


@pytest.mark.long
@pytest.mark.parametrize("mode", derivatives)
@pytest.mark.parametrize("place", PLACES)
def test_derivatives_are_those_of_differences(place, mode):
    """Along rotations about the axes of the body; of what is smooth there, and the way back is the identity."""
    q, smooth = jnp.asarray(PLACES[place]), {"matrix", "scalar_first", "scalar_last"}
    found = derivatives[mode](q, jnp.zeros(3))
    for name in smooth if place.startswith("half") else smooth | {"mrp", "rotvec", "ZYX"}:
        expected = slopes(lambda v, name=name: forms_and_back(q, v)[name], 3, 2e-3)
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=3e-12)
        np.testing.assert_allclose(found[name][-3:], np.eye(3), rtol=0, atol=4 * FLOOR)


@pytest.mark.long
def test_derivatives_are_finite_where_angles_are_not_smooth():
    for q in ([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], [1.0, 0.0, 0.0, 0.0], HALF_TURN):
        assert all(np.isfinite(x).all() for x in derivatives["forward"](jnp.asarray(q), jnp.zeros(3)).values())


@pytest.mark.long
def test_single_precision_stays_single():
    r = Rotation.random(50, rng=2)
    for name, (there, back, _) in PAIRS.items():
        q = there(jnp.asarray(back(np.roll(r.as_quat(), 1, axis=1)), jnp.float32))
        form = back(q)
        assert q.dtype == form.dtype == jnp.float32, name
        assert distance(q, np.roll(r.as_quat(), 1, axis=1)) < 1e-6, name  # observed: 3e-7


@pytest.mark.long
def test_leading_axes_and_transformations():
    q = np.roll(Rotation.random(6, rng=3).as_quat(), 1, axis=1).reshape(2, 3, 4)
    for name, (there, back, _) in PAIRS.items():
        form = back(q)
        assert there(form).shape == (2, 3, 4), name
        np.testing.assert_array_equal(form[1, 2], jax.jit(back)(jnp.asarray(q[1, 2])))
        np.testing.assert_allclose(form[1], jax.vmap(back)(jnp.asarray(q[1])), rtol=0, atol=FLOOR)
        assert there(form[:, :0]).shape == (2, 0, 4), name


def test_what_is_no_rotation_is_nan_inside_jit():
    q, R = np.array([0.5, 0.5, -0.5, 0.5]), np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    rows = np.stack([R, 1.01 * R, -R, 1e200 * R, np.zeros((3, 3)), R * [1, 1, -1], R + 1e-5 * np.eye(3)])
    found = np.asarray(jax.jit(attitude.from_matrix)(rows))
    np.testing.assert_allclose(found[0], q, rtol=0, atol=FLOOR)
    assert np.isnan(found[1:]).all()
    found = jax.jit(attitude.from_matrix)(jnp.asarray(np.clip(rows, -1e38, 1e38), jnp.float32))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()
    turned = np.asarray(jax.jit(attitude.from_rotvec)(np.array([[2 * np.pi / 3, 0, 0], [5e12, 0, 0], [1e200, 0, 0]])))
    np.testing.assert_allclose(turned[0], [0.5, np.sqrt(0.75), 0, 0], rtol=0, atol=FLOOR)
    assert np.isnan(turned[1:]).all()


def test_printed_quaternions_are_normalized_with_a_warning():
    rows = np.array([[0.5, 0.5, 0.5, 0.5], [0.73674, 0.57997, 0.13156, 0.32176]])
    with pytest.warns(RuntimeWarning, match=r"q\[1\] has the norm 0\.9999.*few digits have: normalized") as found:
        q = attitude.from_scalar_first(rows)
    assert len(found) == 1
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1, rtol=0, atol=3e-16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nearly = rows[0] * (1 + 9e-7)
        np.testing.assert_array_equal(attitude.from_scalar_first(nearly), nearly)  # to the last bit


Q = np.array([0.5, 0.1, -0.7, 0.5])
R = Rotation.from_quat(np.roll(Q, -1)).as_matrix()  # from body to space
V = np.array([0.3, -1.2, 0.7])


def test_a_row_of_the_page_scipy_and_all_places_that_take_its_rotations():
    turns = [Rotation.from_rotvec(v) for v in ([0.3, 0, 1.0], [0, 2.0, 0])]
    several = Rotation.concatenate(turns)
    np.testing.assert_array_equal(attitude.to_matrix(turns), attitude.to_matrix(several))
    np.testing.assert_allclose(attitude.to_matrix(turns[0]) @ V, turns[0].apply(V), rtol=0, atol=FLOOR)
    bodies = li.systems.rigid_bodies([1.0, 2.0], [[1.0, 2, 2.5]] * 2, li.potentials.point_masses(1.0, [1.0, 2.0]))
    places = [[0.0, 0, 0], [3.0, 0, 0]]
    expected = bodies.state(places, several).q
    np.testing.assert_array_equal(bodies.state(places, turns).q, expected)
    np.testing.assert_array_equal(bodies.state(places, [turns[0], expected[1, 3:]]).q, expected)
    q = np.asarray(expected[0, 3:])
    for target in (
        li.torques.pd_trace(1.0, 0.1, turns[0]).target,
        li.torques.pd_quaternion(1.0, 0.1, turns[0]).target,
        li.torques.pointing(turns[0], 1.0, 0.1).target.frame,
        li.systems.euler(li.groups.so3, [1.0, 2.0, 3.0]).state(turns[0], velocity=V).q,
        li.systems.rigid_body([1.0, 2.0, 3.0]).state(turns[0], angular_velocity=V).q,
    ):
        np.testing.assert_array_equal(target, q)
    box = li.shapes.box([1.0, 2.0, 3.0], mass=1.0)
    np.testing.assert_array_equal(
        box.moved(rotation=turns[0]).inertia, box.moved(rotation=turns[0].as_matrix()).inertia
    )


def passive(w, x, y, z):
    """The direction cosine matrix of Euler parameters: Schaub & Junkins 2018; 42's Q2C; Trawny & Roumeliotis 2005."""
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z],
        ]
    )


def test_rows_of_the_page_that_rotate_axes_have_the_numbers_of_body_to_space():
    """Basilisk's [BN], 42's CN and JPL's C map components from space to body."""
    q = attitude.from_matrix(R.T, frame="space_to_body")
    np.testing.assert_allclose(passive(*attitude.to_scalar_first(q)), R.T, rtol=0, atol=FLOOR)
    s = np.asarray(attitude.to_mrp(Q))
    tilde, d = np.asarray(so3.hat(s)), s @ s
    by_mrp = np.eye(3) + (8 * tilde @ tilde - 4 * (1 - d) * tilde) / (1 + d) ** 2  # Schaub & Junkins 2018
    np.testing.assert_allclose(by_mrp, R.T, rtol=0, atol=FLOOR)


def test_the_row_of_basilisk():
    kinematics = pytest.importorskip("Basilisk.utilities.RigidBodyKinematics")
    np.testing.assert_allclose(kinematics.MRP2C(np.asarray(attitude.to_mrp(Q))), R.T, rtol=0, atol=FLOOR)
    np.testing.assert_allclose(kinematics.EP2C(np.asarray(attitude.to_scalar_first(Q))), R.T, rtol=0, atol=FLOOR)


def test_the_row_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    found = np.zeros(3)
    mujoco.mju_rotVecQuat(found, V, np.asarray(attitude.to_scalar_first(Q)))
    np.testing.assert_allclose(found, R @ V, rtol=0, atol=FLOOR)


def test_the_row_of_spice():
    spice = pytest.importorskip("spiceypy")
    assert distance(attitude.from_scalar_first(spice.m2q(R.T.copy()), frame="space_to_body"), Q) <= FLOOR
    np.testing.assert_allclose(
        spice.q2m(np.array(attitude.to_scalar_first(Q, frame="space_to_body"))), R.T, rtol=0, atol=FLOOR
    )


def test_the_row_of_urdf():
    """Roll, pitch and yaw are about the fixed axes x, y, z: R = R_z(yaw) R_y(pitch) R_x(roll)."""
    roll, pitch, yaw = 0.3, -0.4, 1.1
    turns = [so3.to_matrix(so3.exp(a * jnp.eye(3)[k])) for k, a in enumerate((roll, pitch, yaw))]
    expected = turns[2] @ turns[1] @ turns[0]
    found = attitude.to_matrix(attitude.from_euler("xyz", [roll, pitch, yaw]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=FLOOR)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_modified_rodrigues_parameters_of_any_length_are_an_attitude(dtype):
    """q = (1 − |σ|², 2σ)/(1 + |σ|²), which tends to −1 where the square overflows; with finite derivatives."""
    e, most = np.array([0.6, 0.0, 0.8]), float(np.finfo(dtype).max)
    lengths = np.array([1.0, 1e3, most**0.5 / 2, most**0.5 * 2, most**0.75, most / 1.01])
    found = attitude.from_mrp((lengths[:, None] * e).astype(dtype))
    exact = np.stack([(1 / lengths - lengths) / (1 / lengths + lengths), 2 / (1 / lengths + lengths)], axis=1)
    np.testing.assert_allclose(found[:, 0], exact[:, 0], rtol=0, atol=2 * np.finfo(dtype).eps)
    np.testing.assert_allclose(found[:, 1:], exact[:, 1:] * e, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).tiny)
    slope = jax.vmap(jax.jacfwd(attitude.from_mrp))((lengths[:, None] * e).astype(dtype))
    assert np.isfinite(slope).all()


def test_a_rotation_vector_without_digits_of_its_angle_is_refused():
    for vector, dtype, most in (([1e13, 0, 0], "float64", r"4.5e\+12"), ([0, 1e20, 0], "float32", r"8.4e\+03")):
        with pytest.raises(ValueError, match=rf"rotvec must be below {most} rad in {dtype}"):
            attitude.from_rotvec(np.array(vector, dtype))
