"""The light of convex bodies: Lambert's sphere, ellipsoids and boxes in closed form, its derivatives, its period."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

import lieint_jax as li
from lieint_jax import measure, shapes
from lieint_jax.groups import so3

HOME = jnp.array([1.0, 0, 0, 0])
TILTED = so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2]))
SUN, OBSERVER = jnp.array([0.6, -0.2, 0.7]), jnp.array([0.9, 0.1, -0.2])
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)


def hull(points):
    """The convex hull of points: vertices and outward triangles."""
    found = ConvexHull(points)
    a, b, c = (found.points[found.simplices[:, k]] for k in range(3))
    flipped = np.sum(np.cross(b - a, c - a) * found.equations[:, :3], axis=1) < 0
    return found, np.where(flipped[:, None], found.simplices[:, ::-1], found.simplices)


def white(mu0, mu):
    return jnp.ones_like(mu0 + mu)


@jax.jit
def sphere_light(facets, alpha):
    at = jnp.array([0.36, 0.48, 0.8])
    aside = jnp.array([0.8, -0.6, 0.0])
    return measure.brightness(facets, TILTED, 3 * at, jnp.cos(alpha) * at + jnp.sin(alpha) * aside)


def test_a_lambert_sphere_has_its_phase_function():
    """(2/3π)(sin α + (π − α) cos α) R². The error of a quadrature over it, observed 6e-5 of the light at opposition
    for 24 rings, falls as n^−2.8; that of the hull of N points, which lies inside, as 1/N, the square of their spacing.
    """
    alpha = np.linspace(0.0, 3.0, 7)
    exact = 2 / (3 * np.pi) * (np.sin(alpha) + (np.pi - alpha) * np.cos(alpha))

    def error(facets):
        return np.sqrt(np.mean((np.array([sphere_light(facets, a) for a in alpha]) - exact) ** 2)) / exact[0]

    smooth = [error(shapes.ellipsoid_facets(np.ones(3), rings)) for rings in (8, 24, 64)]
    assert smooth[1] < 2e-4
    assert 2 < np.log2(smooth[0] / smooth[2]) / 3 < 3.5
    flat = [error(shapes.facets(*hull_of_sphere(n))) for n in (200, 800, 3200)]
    assert np.log2(flat[0] / flat[2]) / 4 == pytest.approx(1, abs=0.1)


def test_a_solid_is_refused_with_the_functions_that_make_facets():
    solid, at, q = shapes.box([1.0, 2.0, 3.0], mass=1.0), jnp.eye(3), jnp.array([1.0, 0, 0, 0])
    body = li.systems.rigid_body(solid)
    run = li.run(li.schemes.exact(body), body.state(angular_velocity=[0.1, 0.2, 0.3]), 0.1, 2, progress=False)
    for light in (lambda: measure.light_curve(run, solid, *at[:2]), lambda: measure.brightness(solid, q, *at[:2])):
        with pytest.raises(
            ValueError, match=r"facets must be shapes\.facets\(.*shapes\.box_facets\(…\), got Shape\(mass=1"
        ):
            light()
    dull = shapes.box_facets([1.0, 2.0, 3.0])
    for facets in (solid, dull):
        for light in (
            lambda facets=facets: measure.glossy_brightness(facets, q, *at[:2]),
            lambda facets=facets: measure.light_changes(facets, at, at),
        ):
            with pytest.raises(ValueError, match=r"facets must be shapes\.GlossyFacets\(normals, .*, got "):
                light()


def hull_of_sphere(n):
    """The hull of n points on a spiral around the unit sphere."""
    z, angle = 1 - (2 * np.arange(n) + 1) / n, np.pi * (1 + np.sqrt(5)) * np.arange(n)
    points = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return points, hull(points)[1]


@pytest.mark.long
@given(st.lists(st.floats(0.5, 2.0), min_size=3, max_size=3), st.integers(0, 100))
def test_an_ellipsoid_that_is_equally_bright_everywhere_shows_its_projected_area(semi_axes, seed):
    """π√(b²c²n₁² + c²a²n₂² + a²b²n₃²), over π; at opposition, where all that is seen is lit."""
    n = np.random.default_rng(seed).normal(size=3)
    a, b, c = semi_axes
    exact = np.linalg.norm(np.array([b * c, c * a, a * b]) * np.asarray(so3.Ad_star(TILTED, jnp.asarray(n)))) / (
        np.linalg.norm(n)
    )
    found = measure.brightness(shapes.ellipsoid_facets(semi_axes, 40), TILTED, n, n, law=white)
    assert float(found) == pytest.approx(exact, rel=3e-3)


def test_the_light_of_a_box_is_that_of_three_faces():
    box = shapes.box_facets([3.0, 2.0, 1.0])
    diagonal = np.ones(3)
    areas = np.array([2.0, 3.0, 6.0])
    for length in (1.0, 1e-200, 1e200):  # |d|² of the others is not in the range of float64
        three = float(measure.brightness(box, HOME, length * diagonal, length * diagonal))
        assert three == pytest.approx(areas.sum() / 3 / np.pi, rel=1e-14, abs=0)
    sun, seen = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.6, 0.8])  # z alone is lit and seen
    assert float(measure.brightness(box, HOME, sun, seen)) == pytest.approx(6 * 0.64 / np.pi, rel=1e-14, abs=0)
    assert float(measure.brightness(box, HOME, sun, -seen)) == 0
    seeliger = measure.brightness(box, HOME, sun, seen, law=lambda mu0, mu: mu0 / (mu0 + mu))
    assert float(seeliger) == pytest.approx(6 * 0.8 / 2 / np.pi, rel=1e-14, abs=0)
    for attitude in (so3.to_matrix(TILTED), jnp.eye(4).at[:3, :3].set(so3.to_matrix(TILTED)).at[0, 3].set(9.0)):
        np.testing.assert_allclose(
            measure.brightness(box, attitude, SUN, OBSERVER), measure.brightness(box, TILTED, SUN, OBSERVER), rtol=1e-14
        )


def test_facets_are_those_of_a_convex_hull():
    points = np.random.default_rng(4).normal(size=(60, 3)) * [3.0, 2.0, 1.0] + [5.0, 0.0, -2.0]
    found, triangles = hull(points)
    for faces in (triangles, triangles[:, ::-1]):
        facets = shapes.facets(points, faces)
        np.testing.assert_allclose(facets.normals, found.equations[:, :3], rtol=0, atol=1e-12)
        assert float(jnp.sum(facets.areas)) == pytest.approx(found.area, rel=1e-13, abs=0)
    for other in (shapes.ellipsoid_facets([3.0, 2.0, 1.0], 9), shapes.box_facets([3.0, 2.0, 1.0])):
        np.testing.assert_allclose(other.areas @ other.normals, 0, rtol=0, atol=1e-14)  # closed
    sphere = shapes.ellipsoid_facets([1.0, 1.0, 1.0], 6)
    second = jnp.einsum("f,fi,fj->ij", sphere.areas, sphere.normals, sphere.normals)
    np.testing.assert_allclose(second, 4 * np.pi / 3 * np.eye(3), rtol=0, atol=1e-13)


def test_a_body_that_is_not_convex_raises():
    _, faces = hull(CUBE)
    shapes.facets(CUBE, faces)
    rounded = CUBE.copy()
    rounded[7] -= 1e-4  # as in a file of four digits
    shapes.facets(rounded, faces)
    dented = np.vstack([CUBE, [0.5, 0.5, 0.8]])
    top = np.flatnonzero((CUBE[faces, 2] == 1).all(axis=1))
    ring = [[1, 5], [5, 7], [7, 3], [3, 1]]
    open_box = [f for k, f in enumerate(faces.tolist()) if k not in top]
    with pytest.raises(ValueError, match=r"must be convex, but vertices are 0\.\d+ above the plane of facet"):
        shapes.facets(dented, [*open_box, *([a, b, 8] for a, b in ring)])
    with pytest.raises(ValueError, match="must be closed"):
        shapes.facets(CUBE, faces[1:])
    with pytest.raises(ValueError, match="has no area"):
        shapes.facets([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def tumbling(J, steps=40):
    body = li.systems.rigid_body(J)
    state = body.state(TILTED, angular_velocity=[0.3, 0.1, 1.0])
    return li.integrate(li.schemes.so3_midpoint(body), state, 0.2, steps)


@jax.jit
def total_light(J, semi_axes):
    """The sum over a run, as a function of the inertia and the shape."""
    facets = shapes.ellipsoid_facets(semi_axes, 16)
    q = tumbling(J).state.q
    return jnp.sum(jax.vmap(lambda q: measure.brightness(facets, q, SUN, OBSERVER))(q))


@pytest.mark.long
def test_derivatives_by_inertia_and_shape_are_those_of_differences():
    """Through a whole run. Lambert's light is once differentiable where a facet rises; observed 3e-9 of them."""
    at = jnp.array([1.0, 1.4, 1.9]), jnp.array([3.0, 2.0, 1.5])
    slopes = jax.jit(jax.grad(total_light, (0, 1)))(*at)
    for k, slope in enumerate(slopes):
        for direction in np.eye(3):
            ends = [total_light(*(x + h * direction if j == k else x for j, x in enumerate(at))) for h in (1e-6, -1e-6)]
            assert float(slope @ direction) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=2e-8)


def test_a_light_curve_is_the_brightness_of_each_state():
    """Of one body and of a batch; directions fixed, in a table, and as functions of time."""
    body = li.systems.rigid_body([1.0, 1.4, 1.9])
    facets = shapes.ellipsoid_facets([3.0, 2.0, 1.5], 6)
    states = jax.vmap(lambda w: body.state(TILTED, angular_velocity=w))(jnp.array([[0.3, 0.1, 1.0], [0.9, 0.2, 0.1]]))
    run = li.run(li.schemes.so3_midpoint(body), states, 0.2, 30, progress=False)
    found = measure.light_curve(run, facets, SUN, OBSERVER)
    assert found.shape == (31, 2)
    q = run.state.q[:, 1]
    expected = [measure.brightness(facets, x, SUN, OBSERVER) for x in q[::10]]
    np.testing.assert_allclose(found[::10, 1], expected, rtol=1e-13)
    one = run.member(1)
    np.testing.assert_allclose(measure.light_curve(one, facets, SUN, OBSERVER), found[:, 1], rtol=1e-13)
    moving = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t])  # noqa: E731
    table = np.array([moving(t) for t in run.t])
    by_function, by_table = (measure.light_curve(run, facets, sun, OBSERVER) for sun in (moving, table))
    np.testing.assert_allclose(by_function, by_table, rtol=1e-13)
    np.testing.assert_allclose(
        by_table[::10, 1],
        [measure.brightness(facets, x, s, OBSERVER) for x, s in zip(q[::10], table[::10], strict=True)],
        rtol=1e-13,
    )
    assert np.isnan(measure.brightness(facets, HOME * jnp.nan, SUN, OBSERVER))
    with pytest.raises(ValueError, match=r"sun must have shape \(3,\) or \(31, 3\), got \(5, 3\)"):
        measure.light_curve(run, facets, table[:5], OBSERVER)
    with pytest.raises(ValueError, match="sun must be a function of the time"):
        measure.light_curve(run, facets, lambda t: t, OBSERVER)
    with pytest.raises(ValueError, match="measurements need a run"):
        measure.light_curve(tumbling(jnp.array([1.0, 1.4, 1.9]), 2), facets, SUN, OBSERVER)


@pytest.mark.long
def test_members_that_start_at_different_times_have_the_directions_of_their_own_times():
    """Functions of time are evaluated on the clock of each member, as of `run.member(k)`."""
    body = li.systems.rigid_body([1.0, 1.4, 1.9])
    state = body.state(TILTED, angular_velocity=[0.3, 0.1, 1.0])
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state._replace(t=0.0))._replace(t=jnp.array([0.0, 5.0]))
    run = li.run(li.schemes.so3_midpoint(body), states, 0.2, 10, progress=False)
    facets = shapes.ellipsoid_facets([3.0, 2.0, 1.5], 6)
    moving = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t])  # noqa: E731
    light, tilts = measure.light_curve(run, facets, moving, OBSERVER), measure.tilt(run, direction=moving)
    for k in range(2):
        table = np.array([moving(t) for t in np.asarray(run.t) + 5.0 * k])
        expected = [measure.brightness(facets, q, s, OBSERVER) for q, s in zip(run.state.q[:, k], table, strict=True)]
        np.testing.assert_allclose(light[:, k], expected, rtol=1e-13)
        np.testing.assert_allclose(tilts[:, k], measure.tilt(run.member(k), direction=table), rtol=0, atol=1e-14)


@pytest.mark.long
def test_the_light_of_an_ellipsoid_repeats_twice_in_a_rotation():
    """At 80 random times over 30 rotations of 1.7; the period is found to a hundredth of its resolution."""
    body = li.systems.rigid_body([1.0, 1.4, 1.9])
    state = body.state(angular_velocity=[0.0, 0.0, 2 * np.pi / 1.7])
    times = np.sort(np.random.default_rng(8).uniform(0, 51.0, 80))
    run = li.run(li.schemes.exact(body), state, 0.1, 510, save_at=times, progress=False)
    light = measure.light_curve(run, shapes.ellipsoid_facets([3.0, 2.0, 1.5], 16), SUN, SUN)
    found = measure.periodogram(run.t, -2.5 * np.log10(light), frequencies=np.arange(0.3, 2.0, 2e-4))
    best = found.power.argmax()
    assert found.power[best] > 0.9
    assert found.false_alarm_probability[best] < 1e-20
    assert found.frequency[best] == pytest.approx(2 / 1.7, abs=1 / 51 / 20)
