"""The light of facets with a lobe against hand-made cases, and the spin states that have the same light."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lights import directions
from scipy.spatial.transform import Rotation

from lieint_jax import integrate, measure, schemes, shapes, systems
from lieint_jax.groups import so3

ONE = jnp.array([1.0, 0.0, 0.0, 0.0])
AXIS_ROTATIONS = Rotation.create_group("O").as_matrix()  # the 24 that permute the axes up to sign
SIDES = [*np.eye(3), *-np.eye(3)]


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


def painted(normals, area=np.pi, diffuse=0.5, specular=0.25, exponent=3.0):
    """Facets with these normals; numbers, or one for each facet."""
    each = (jnp.broadcast_to(jnp.asarray(x, float), len(normals)) for x in (area, diffuse, specular, exponent))
    return shapes.GlossyFacets(jnp.asarray(normals, float), *each)


def box():
    """Three pairs of equal sides: half turns are its symmetries."""
    return painted(SIDES, area=[1.0, 2.0, 3.0, 1.0, 2.0, 3.0], diffuse=0.3, specular=0.4, exponent=20.0)


def test_a_plate_has_lambert_s_light_and_a_lobe_in_the_mirror_direction():
    """cos² 60° (0.5 + 0.25), the lobe at its top; 0.5 + 0.25 face on; nearly nothing from behind."""
    body = painted([[0.0, 0.0, 1.0]])
    left, right, top = unit(-np.sqrt(3), 0, 1), unit(np.sqrt(3), 0, 1), np.array([0.0, 0.0, 1.0])
    light = jax.jit(lambda s, o: measure.glossy_brightness(body, ONE, s, o))
    edge = measure.SUN_RADIUS**2  # what the ramp adds, relative, is of this size
    assert float(light(left, right)) == pytest.approx(0.75 / 4, rel=4 * edge)
    assert float(light(top, top)) == pytest.approx(0.75, rel=2 * edge)
    assert 0 < float(light(-top, right)) < edge


def test_the_light_of_a_body_is_the_sum_over_its_facets():
    """Beside a loop in NumPy with max(0, x); the ramp differs from it by ε/2 of a facet at an edge, here by 1e-4."""
    f, (q, sun, observer) = box(), directions(1)
    ours = jax.vmap(measure.glossy_brightness, (None, 0, 0, 0))(f, q, sun, observer)
    for light, attitude, s, o in zip(ours, q, sun, observer, strict=True):
        R = np.asarray(so3.to_matrix(jnp.asarray(attitude)))
        theirs = 0.0
        for n, area, diffuse, specular, exponent in zip(*(np.asarray(x) for x in jax.tree.leaves(f)), strict=True):
            lit, seen, mirrored = (max(0.0, float(R @ n @ v)) for v in (s, o, unit(*(s + o))))
            theirs += area / np.pi * lit * seen * (diffuse + specular * mirrored**exponent)
        assert float(light) == pytest.approx(theirs, abs=5e-4 * float(jnp.max(ours)))


def test_without_a_lobe_the_light_is_that_of_lambert():
    """But for the ramp, a part of 1e-3 where a facet is seen edge-on."""
    q, sun, observer = directions(6)
    matt = painted(SIDES, area=1.0, diffuse=1.0, specular=0.0)
    glossy = jax.vmap(measure.glossy_brightness, (None, 0, 0, 0))(matt, q, sun, observer)
    plain = jax.vmap(measure.brightness, (None, 0, 0, 0))(matt, q, sun, observer)
    np.testing.assert_allclose(glossy, plain, rtol=0, atol=3e-3 * plain.max())


def test_derivatives_of_the_light_are_those_of_differences():
    q, sun, observer = (x[0] for x in directions(2))

    def magnitude(turn, sun):
        attitude = so3.multiply(so3.exp(turn), jnp.asarray(q))
        return -2.5 * jnp.log10(measure.glossy_brightness(box(), attitude, sun, jnp.asarray(observer)))

    both = jax.jit(jax.value_and_grad(magnitude, (0, 1)))
    zero, h = jnp.zeros(3), 1e-6
    _, (of_turn, of_sun) = both(zero, jnp.asarray(sun))
    for k, axis in enumerate(jnp.eye(3)):
        for found, change in ((of_turn[k], (h * axis, 0 * axis)), (of_sun[k], (0 * axis, h * axis))):
            more, less = (both(zero + s * change[0], sun + s * change[1])[0] for s in (1, -1))
            assert float(found) == pytest.approx(float(more - less) / (2 * h), abs=6e-9)  # observed: 1e-9


def test_derivatives_in_all_directions_are_those_in_each():
    """By the attitude alone, a gradient; by all at once; in forward and in reverse mode."""
    q, sun, observer = (jnp.asarray(x[0]) for x in directions(8))
    at, light = (box(), q, sun, observer), lambda *x: measure.glossy_brightness(*x)
    gradients = jax.jit(jax.grad(light, range(4)))(*at)
    every = jax.jit(lambda *x: jax.jvp(light, x, x)[1])(*at)
    parts = [sum(map(jnp.vdot, *map(jax.tree.leaves, pair))) for pair in zip(gradients, at, strict=True)]
    np.testing.assert_allclose(every, sum(parts), rtol=1e-14)  # observed: 1e-15
    alone = jax.jit(jax.jacfwd(light, 1))(*at)
    np.testing.assert_allclose(alone, gradients[1], rtol=0, atol=1e-14)


def test_the_symmetries_of_the_facets_are_found():
    half_turns = [g for g in AXIS_ROTATIONS if measure.is_light_symmetry(box(), g)]
    assert len(half_turns) == 4
    assert all(np.allclose(abs(g), np.eye(3), rtol=0, atol=1e-12) for g in half_turns)
    assert measure.is_light_symmetry(box(), -np.eye(3))
    assert sum(measure.is_light_symmetry(painted(SIDES), g) for g in AXIS_ROTATIONS) == 24  # a cube
    one_side = painted(SIDES, diffuse=[0.6, *[0.5] * 5])
    assert sum(measure.is_light_symmetry(one_side, g) for g in AXIS_ROTATIONS) == 4  # about the painted side
    assert not measure.is_light_symmetry(one_side, -np.eye(3))


def test_symmetric_states_have_the_same_light_to_round_off():
    """Under directions that are held; under moving ones mirror and exchange alter it, half turns of the body never."""
    q, sun, observer = directions(3)
    held = np.repeat(sun[:1], len(q), axis=0), np.repeat(observer[:1], len(q), axis=0)
    assert measure.light_differences(box(), q, *held).max() < 1e-14  # observed: 2e-15
    moving = measure.light_differences(box(), q, sun, observer)
    assert moving[0] < 2e-14
    assert moving[1:].min() > 0.1


@pytest.mark.parametrize("normals", [[0, 2], [1, 2, 3]])
def test_relabeled_bodies_have_the_light_that_their_turns_leave(normals):
    """All turns of one change have one light, and no two changes a name."""
    sides = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]]
    diffuse = [0.1 + 0.2 * (k >= 2) for k in normals]
    body = painted([*(sides[k] for k in normals), *SIDES], diffuse=[*diffuse, *[0.7] * 6])
    q, sun, observer = directions(9)
    magnitudes = jax.jit(jax.vmap(lambda *x: -2.5 * jnp.log10(measure.glossy_brightness(body, *x))))
    lights = {}
    for change in measure.light_changes(body, sun[:1], observer[:1])[:24]:
        lights.setdefault(change.name, []).append(magnitudes(jnp.asarray(change.attitudes(q)), sun, observer))
    turns = sum(measure.is_light_symmetry(body, g) for g in AXIS_ROTATIONS)
    assert len(lights) == 24 // turns
    for same in lights.values():
        assert len(same) == turns
        assert max(float(jnp.abs(light - same[0]).max()) for light in same) < 3e-14  # observed: 4e-15
    first = [same[0] for same in lights.values()]
    assert min(float(jnp.abs(a - b).max()) for a, b in itertools.combinations(first, 2)) > 1e-3


def test_states_are_classified_by_the_change_that_leads_to_them():
    _, sun, observer = directions(5, 1)
    every = measure.light_changes(box(), sun, observer)
    assert len(every) == 4 * 24
    best = measure.SpinStates(np.array([[0.5, 0.5, -0.1, 0.7]]), np.array([[1.0, 5.0, 0.3]]), np.array([[0.7, 1, 1.4]]))
    images = [every[k](best) for k in (0, 17, 50, 95)]
    found = measure.SpinStates(*map(np.concatenate, zip(*images, strict=True)))
    assert measure.classify_light(found, best, every).tolist() == [0, 17, 50, 95]
    assert measure.classify_light(found._replace(rate=-found.rate), best, every)[0] == -1
    assert found.select(0).distance(best) == pytest.approx(0, abs=1e-6)


def test_images_of_the_mirror_solution_are_named_from_the_true_one():
    """A first session may prefer the mirror solution: its image in the mirror is the true motion."""
    _, sun, observer = directions(5, 1)
    every = measure.light_changes(box(), sun, observer)
    truth = measure.SpinStates(
        np.array([[0.6, 0.2, -0.5, 0.6]]), np.array([[26.0, 15, 10]]), np.array([[0.6, 1.2, 1.4]])
    )
    own = [change for change in every if change.symmetry == 0]
    mirror = next(change for change in own if change.name == "mirror")(truth)
    images = measure.SpinStates(*map(np.concatenate, zip(*(change(mirror) for change in own), strict=True)))
    names = [every[k].name for k in measure.classify_light(images, truth, every)]
    assert sorted(names) == sorted(change.name for change in own)
    assert names[[change.name for change in own].index("as it is")] == "mirror"
    assert names[[change.name for change in own].index("mirror")] == "as it is"


@pytest.mark.long
def test_every_change_of_a_motion_is_a_motion():
    """Rotated in space, relabeled in the body: still a solution of Euler's equations, with the moments relabeled."""
    _, sun, observer = directions(4, 1)

    @jax.jit
    def later(q, rate, J):
        body = systems.RigidBody(J)
        state = body.state(q, angular_velocity=jnp.deg2rad(rate))
        return integrate(schemes.preprocessed(body, 6), state, 7.0 / 20, 20).state.q[-1]

    begin = measure.SpinStates(unit(0.6, 0.2, -0.5, 0.6)[None], np.array([[26.0, 15, 10]]), np.array([[0.6, 1.2, 1.4]]))
    end = np.asarray(later(*(jnp.asarray(x[0]) for x in begin)))
    every = measure.light_changes(box(), sun, observer)
    for change in every[::5]:
        found = np.asarray(later(*(jnp.asarray(x[0]) for x in change(begin))))
        assert abs(change.attitudes(end[None])[0] @ found) == pytest.approx(1, abs=1e-14)
