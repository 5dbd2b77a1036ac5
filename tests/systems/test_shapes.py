"""Shapes: closed forms, meshes against solids and quadrature, derivatives, files, and what accepts them."""

import itertools
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cubes import CUBE, FACES, QUADS

import lieint_jax as li
from lieint_jax import shapes, systems, torques


def sphere(levels):
    """An octahedron whose triangles are cut into four `levels` times, its vertices on the unit sphere."""
    vertices = [np.array(v, float) for v in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    faces = [(x, y, z) if (x + y + z) % 2 else (x, z, y) for x, y, z in itertools.product((0, 1), (2, 3), (4, 5))]
    for _ in range(levels):
        middle, finer = {}, []
        for face in faces:
            inner = []
            for i, j in zip(face, face[1:] + face[:1], strict=True):
                key = (min(i, j), max(i, j))
                if key not in middle:
                    middle[key] = len(vertices)
                    v = vertices[i] + vertices[j]
                    vertices.append(v / np.linalg.norm(v))
                inner.append(middle[key])
            (a, b, c), (d, e, f) = face, inner
            finer += [(a, d, f), (d, b, e), (f, e, c), (d, e, f)]
        faces = finer
    return np.array(vertices), np.array(faces)


def hull(seed):
    """A convex polyhedron with fifteen random vertices, its faces oriented outward."""
    from scipy.spatial import ConvexHull

    points = np.random.default_rng(seed).normal(size=(15, 3)) * [3, 2, 1] + [5, -2, 1]
    found = ConvexHull(points)
    used, faces = np.unique(found.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    at = points[used]
    inside = at.mean(axis=0)
    outward = (
        np.einsum(
            "fi,fi->f",
            np.cross(at[faces[:, 1]] - at[faces[:, 0]], at[faces[:, 2]] - at[faces[:, 0]]),
            at[faces[:, 0]] - inside,
        )
        > 0
    )
    return at, np.where(outward[:, None], faces, faces[:, ::-1])


def nodes(at, faces, order=4):
    """Quadrature points of a polyhedron and their volumes, exact to degree 2·order − 3: cones over the triangles."""
    (x, w), apex = np.polynomial.legendre.leggauss(order), at.mean(axis=0)
    u, w = (x + 1) / 2, w / 2
    points, weights = [], []
    for a, b, c in at[faces] - apex:
        volume = np.dot(a, np.cross(b, c))
        for (r, wr), (s, ws), (t, wt) in itertools.product(zip(u, w, strict=True), repeat=3):
            points.append(r * (a + s * ((b - a) + t * (c - b))) + apex)
            weights.append(volume * wr * ws * wt * r * r * s)
    return np.array(points), np.array(weights)


def assert_same(a, b, tolerance):
    np.testing.assert_allclose(a.mass, b.mass, rtol=tolerance)
    size = float(jnp.sqrt(jnp.max(b.second) / b.mass))
    np.testing.assert_allclose(a.center, b.center, rtol=0, atol=tolerance * size)
    for n in (2, 3, 4):
        np.testing.assert_allclose(a.moments(n), b.moments(n), rtol=0, atol=tolerance * float(b.mass) * size**n)


@pytest.mark.long
def test_solids_against_quadrature():
    """Means of monomials over the solids, by Gauss' rule in coordinates in which they are polynomials."""
    x, w = np.polynomial.legendre.leggauss(6)
    unit = [
        (np.array(p), np.prod(q))
        for p, q in zip(itertools.product(x, repeat=3), itertools.product(w / 2, repeat=3), strict=True)
    ]
    angles = [2 * np.pi * k / 8 for k in range(8)]

    def ball(p):  # radius, height on the sphere, angle by the mean over eight
        r, z = (1 + p[0]) / 2, p[1]
        rho = r * np.sqrt(1 - z * z)
        return [(np.array([rho * np.cos(a), rho * np.sin(a), r * z]), 3 * r * r / 8) for a in angles]

    def rod(p):
        r = (1 + p[0]) / 2
        return [(np.array([r * np.cos(a), r * np.sin(a), p[2]]), 2 * r / 8) for a in angles]

    a = np.array([3.0, 2.0, 1.0])
    for shape, scale, places in (
        (shapes.ellipsoid(a, mass=7.0), a, ball),
        (shapes.box(2 * a, mass=7.0), a, lambda p: [(p, 1.0)]),
        (shapes.cylinder(2.0, 3.0, mass=7.0), np.array([2.0, 2.0, 1.5]), rod),
    ):
        parts = [(7 * w * v, scale * r) for p, w in unit for r, v in places(p)]
        masses, points = (np.array(column) for column in zip(*parts, strict=True))
        assert_same(shapes.sites(masses, points), shape, 2e-14)  # observed 3e-15


def test_a_mesh_of_a_box_is_the_box():
    found = shapes.mesh(CUBE * [3, 2, 1] + [100, 0, -50], FACES, density=2.0)
    exact = shapes.box([3, 2, 1], density=2.0).moved([101.5, 1.0, -49.5])
    assert_same(found, exact, 1e-13)  # observed 2e-14, the rounding of the vertices
    assert_same(shapes.mesh(CUBE * [3, 2, 1] + [100, 0, -50], np.array(FACES)[:, ::-1], mass=12.0), exact, 1e-13)
    at, F = np.vstack([[[0, 0, 1e9]], CUBE * [3, 2, 1] + [100, 0, -50]]), np.add(FACES, 1)
    assert_same(shapes.mesh(at, F, density=2.0), exact, 1e-13)  # a vertex of no face is not of the body
    assert np.isclose(shapes.facets(at, F).areas.sum(), 22, rtol=1e-14, atol=0)


INWARD = [face[::-1] for face in FACES]
OUTSIDE, WITHIN = np.add(CUBE, [7, 0, 0]), np.add(CUBE, [2, 2, 2])


def two(corners, faces, outer=FACES):
    """A cube with edges of 5, and a second one of 1."""
    return np.concatenate([5 * CUBE, corners]), [*outer, *(np.array(faces) + 8)]


@pytest.mark.parametrize(
    ("corners", "faces", "mass"), [(OUTSIDE, FACES, 126), (WITHIN, INWARD, 124), (np.add(CUBE, [5, 5, 0]), FACES, 126)]
)
def test_a_mesh_of_two_parts_has_the_sum_of_their_signed_volumes(corners, faces, mass):
    """Two cubes, a cube with a cavity, cubes with a common edge; and all faces the other way round."""
    for at, F in (two(corners, faces), two(corners, np.array(faces)[:, ::-1], INWARD)):
        assert float(shapes.mesh(at, F, density=1.0).mass) == pytest.approx(mass, rel=1e-14, abs=0)


def test_a_body_may_lie_in_a_cavity():
    at, F = two(3 * CUBE + 1, INWARD)
    deep = np.concatenate([at, WITHIN]), [*F, *(np.array(FACES) + 16)]
    assert float(shapes.mesh(*deep, density=1.0).mass) == pytest.approx(125 - 27 + 1, rel=1e-14, abs=0)


@pytest.mark.long
def test_meshes_of_an_ellipsoid_approach_it_to_second_order():
    exact, errors = shapes.ellipsoid([3.0, 2.0, 1.0], density=1.0), []
    for levels in (2, 3, 4):
        vertices, faces = sphere(levels)
        found = shapes.mesh(vertices * [3, 2, 1], faces, density=1.0)
        errors.append(
            [abs(found.mass - exact.mass), *(jnp.abs(found.moments(n) - exact.moments(n)).max() for n in (2, 4))]
        )
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(np.abs(orders[-1] - 2) < 0.05), orders


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_convex_polyhedron_is_its_quadrature(seed):
    at, faces = hull(seed)
    points, weights = nodes(at, faces)
    assert_same(shapes.mesh(at, faces, density=1.5), shapes.sites(1.5 * weights, points), 1e-13)  # observed 1e-14


@pytest.mark.long
def test_a_convex_polyhedron_is_its_monte_carlo_sum():
    """Within four standard errors: an independent definition of inside, by the planes of the faces."""
    at, faces = hull(3)
    found = shapes.mesh(at, faces, density=1.0)
    low, high = at.min(axis=0), at.max(axis=0)
    r = np.random.default_rng(0).uniform(low, high, (200000, 3))
    normals = np.cross(at[faces[:, 1]] - at[faces[:, 0]], at[faces[:, 2]] - at[faces[:, 0]])
    inside = np.all(r @ normals.T <= np.einsum("fi,fi->f", normals, at[faces[:, 0]]), axis=1)
    for value, f in ((found.mass, 1.0), (found.second[0, 1], (r - found.center)[:, 0] * (r - found.center)[:, 1])):
        samples = np.where(inside, f, 0) * np.prod(high - low)
        assert abs(float(value) - samples.mean()) < 4 * samples.std() / np.sqrt(len(r))


@pytest.mark.long
def test_slopes_by_the_vertices():
    """Of all moments along a random direction, against sixth-order differences, forwards and in reverse."""
    at, faces = hull(4)
    rng = np.random.default_rng(5)
    direction, weights = jnp.array(rng.normal(size=at.shape)), jnp.array(rng.normal(size=(3, 3, 3, 3)))

    @jax.jit
    def functional(vertices):
        shape = shapes.mesh(vertices, faces, density=1.0)
        total = shape.mass + jnp.sum(shape.center) + jnp.sum(weights[0, 0] * shape.inertia)
        return total + jnp.sum(weights[0] * shape.third) + jnp.sum(weights * shape.fourth)

    at = jnp.array(at)
    forward = jax.jvp(functional, (at,), (direction,))[1]
    reverse = jnp.sum(jax.grad(functional)(at) * direction)
    h = 1e-3
    values = [float(functional(at + k * h * direction)) for k in (-3, -2, -1, 1, 2, 3)]
    differences = np.dot([-1, 9, -45, 45, -9, 1], values) / (60 * h)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-12, abs=1e-12)
    assert float(forward) == pytest.approx(differences, rel=1e-10, abs=1e-12)  # observed 1e-11


@pytest.mark.long
def test_sums_and_moves():
    """Two halves are the whole; a rotated body's moments are those of its rotated points."""
    whole = shapes.box([4, 2, 1], density=3.0)
    half = shapes.box([2, 2, 1], density=3.0)
    assert_same(half.moved([1.0, 0, 0]) + half.moved([-1.0, 0, 0]), whole, 1e-15)
    hollow = whole + shapes.box([2, 2, 1], density=-3.0).moved([1.0, 0, 0])
    # the fourth moments of the whole, 32 times as large, are rounded: observed 2 and, by jaxlib 0.9, 3 of their ulp
    assert_same(hollow, half.moved([-1.0, 0, 0]), 4e-14)
    rng = np.random.default_rng(6)
    masses, points = rng.uniform(1, 2, 5), rng.normal(size=(5, 3))
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    moved = shapes.sites(masses, points).moved([1.0, 2.0, 3.0], R)
    assert_same(moved, shapes.sites(masses, points @ R.T + [1, 2, 3]), 1e-14)
    moments, axes = moved.principal_axes()
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, moved.inertia, atol=1e-13, rtol=0)
    assert np.linalg.det(axes) == pytest.approx(1, abs=1e-14)
    aligned = moved.aligned()
    np.testing.assert_allclose(aligned.inertia, moments, rtol=1e-13)
    assert_same(aligned, shapes.sites(masses, (points @ R.T - (moved.center - jnp.array([1.0, 2, 3]))) @ axes), 1e-13)


def _rows(triangle):
    return "".join(f"   vertex {x} {y} {z}\n" for x, y, z in triangle)


def test_stl_files_are_read_in_text_and_binary(tmp_path):
    """The triangles of a cube: vertices at one place are merged, so that the surface is closed."""
    triangles = np.array([CUBE[list(corners)] for q in QUADS for corners in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    text, binary = tmp_path / "cube.stl", tmp_path / "binary.STL"
    facets = [f" facet normal 0 0 0\n  outer loop\n{rows}  endloop\n endfacet\n" for rows in map(_rows, triangles)]
    text.write_text("solid cube\n" + "".join(facets) + "endsolid cube\n")
    records = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["corners"] = triangles
    binary.write_bytes(b"solid".ljust(80) + len(triangles).to_bytes(4, "little") + records.tobytes())
    for path in (text, binary):
        vertices, faces = shapes.surface(path)
        assert vertices.shape == (8, 3)
        np.testing.assert_array_equal(vertices[faces], triangles)
    text.write_text("solid cube\nouter loop\n vertex 0 0 x\n vertex 1 0 0\n vertex 0 1 0\nendloop")
    with pytest.raises(ValueError, match=r"cube\.stl, line 3: a coordinate must be a finite number, got 'x'"):
        shapes.surface(text)
    binary.write_bytes(binary.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"binary\.STL: 12 triangles of 50 bytes must follow"):
        shapes.surface(binary)


def test_obj_files_are_read(tmp_path):
    """Polygons, negative indices, texture and normal indices, a seam of vertices that are written twice."""
    path = tmp_path / "cube.obj"
    lines = [f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in CUBE]
    lines += ["# a comment", "vn 0 0 1", *("f " + " ".join(f"{k + 1}/1/1" for k in q) for q in QUADS[:-1])]
    lines += [f"v {x} {y} {z}" for x, y, z in CUBE[[1, 5, 7, 3]]] + ["f -4 -3 -2 -1"]
    path.write_text("\n".join(lines))
    cube = shapes.obj(path, density=1e-6, scale=1000.0)
    assert float(cube.mass) == pytest.approx(1000.0, rel=1e-14, abs=0)
    np.testing.assert_allclose(cube.center, [500.0] * 3, rtol=1e-14)
    for index in (-9, 0, 9):
        path.write_text("\n".join([*lines[:8], f"f 1 2 {index}"]))
        with pytest.raises(ValueError, match=f"cube.obj, line 9: a face must have indices.* got .*{index}"):
            shapes.obj(path, mass=1.0)
    path.write_text("v 1 2 x\nf 1 1 1")
    with pytest.raises(ValueError, match=r"cube.obj, line 1: a coordinate must be a finite number, got 'x'"):
        shapes.obj(path, mass=1.0)


@pytest.mark.long
def test_single_precision_stays_single_and_has_its_digits():
    at, faces = hull(9)
    double, single = (shapes.mesh(jnp.asarray(at, dtype), faces, mass=2.0) for dtype in ("float64", "float32"))
    assert {x.dtype for x in jax.tree.leaves(single)} == {np.dtype("float32")}
    assert_same(single, double, 2e-6)  # observed 4e-7


def test_bodies_of_given_inertia_join_as_solids_do():
    """A box is eight of its octants, each given by mass, center and inertia alone, moved and rotated together."""
    edges, R = np.array([3.0, 2.0, 1.0]), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    octant = shapes.box(edges / 2, mass=1.5)
    parts = [
        shapes.body(mass=1.5, inertia=J, center=center)
        for k, center in enumerate((CUBE - 0.5) * edges / 2)
        for J in [octant.inertia if k % 2 else jnp.diag(octant.inertia)]
    ]
    found, exact = (x.moved([1.0, 2.0, 3.0], R) for x in (sum(parts[1:], parts[0]), shapes.box(edges, mass=12.0)))
    assert float(found.mass) == 12.0
    np.testing.assert_allclose(found.center, exact.center, rtol=1e-14)
    np.testing.assert_allclose(found.inertia, exact.inertia, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.moments(2), exact.moments(2), rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.aligned().inertia, exact.aligned().inertia, rtol=1e-13)
    assert parts[1].diagonal
    np.testing.assert_array_equal(parts[1].inertia, octant.inertia)


def test_moments_that_are_not_known_are_refused_by_name():
    given = shapes.body(mass=2.0, inertia=[1.0, 1.2, 1.4])
    solid = shapes.ellipsoid(np.sqrt([0.8 * 2.5, 0.6 * 2.5, 0.4 * 2.5]), mass=2.0)
    for unknown in (given, solid + given.moved([1.0, 0, 0])):
        assert unknown.third is None
        with pytest.raises(ValueError, match="moments of order 3 are not known of a body that is given by mass"):
            unknown.moments(3)
        with pytest.raises(ValueError, match=r"gravity to order 4 needs more of shapes\[1\]: the moments of order 3"):
            li.potentials.mutual_gravity(1.0, [solid, unknown])
    found, exact = (li.potentials.mutual_gravity(1.0, [x, 1.0], 2) for x in (given, solid))
    np.testing.assert_allclose(found.second, exact.second, rtol=0, atol=1e-15)
    assert not found.third.any()


@pytest.mark.long
def test_systems_and_potentials_accept_a_shape():
    at, faces = hull(7)
    shape = shapes.mesh(at, faces, mass=2.0)
    body = li.systems.rigid_body(shape)
    np.testing.assert_array_equal(body.inertia, shape.inertia)
    ball = shapes.ellipsoid([1.0, 1.0, 1.0], mass=3.0)
    np.testing.assert_allclose(li.systems.rigid_body(ball).inertia, [1.2] * 3, rtol=1e-15)
    pair = [shape, ball]
    bodies = li.systems.rigid_bodies(pair, pair, li.potentials.maccullagh(1.0, pair, pair))
    assert bodies.inertias.shape == (2, 3, 3)
    np.testing.assert_allclose(bodies.masses, [2.0, 3.0], rtol=1e-15)
    slope = jax.grad(lambda a: jnp.sum(li.systems.rigid_body(shapes.ellipsoid(a, density=1.0)).inertia))(jnp.ones(3))
    assert np.all(slope > 0)
    assert shapes.ellipsoid(jnp.ones(3, "float32"), mass=1.0).fourth.dtype == jnp.float32


FRAME, ORBIT = [1.0, 0.0, 0.0, 0.0], partial(li.orbits.kepler, 1.0, 1.0, 0.1)
TAKING_INERTIA = {
    "rigid_body": systems.rigid_body,
    "gyrostat": lambda J: systems.gyrostat(J, [0, 0, 1.0]),
    "driven_gyrostat": lambda J: systems.driven_gyrostat(J, lambda t: jnp.zeros(3)),
    "damped_body": lambda J: systems.damped_body(J, 0.1),
    "torqued_body": lambda J: systems.torqued_body(J, torques.viscous(0.1)),
    "heavy_top": lambda J: systems.heavy_top(J, [0, 0, 1.0]),
    "potential_top": lambda J: systems.potential_top(J, lambda R: R[0, 0], None),
    "driven_top": lambda J: systems.driven_top(J, lambda R, t: t * R[0, 0], None),
    "gravity_gradient": lambda J: systems.gravity_gradient(J, ORBIT()),
    "law of gravity_gradient": lambda J: torques.gravity_gradient(ORBIT(), J),
    "pointing": lambda J: torques.pointing(FRAME, 1.0, 1.0, J),
    "sliding_mode": lambda J: torques.sliding_mode(FRAME, J, 1.0, 1.0, layer=0.1),
    "body_inertia": lambda J: torques.body_inertia(J, np.eye(3), 0.01),
    "rigid_bodies": lambda J: systems.rigid_bodies(np.ones(2), [J, J], lambda x, R: x[0, 0]),
    "masses of rigid_bodies": lambda J: systems.rigid_bodies([J, J], np.ones((2, 3)), lambda x, R: x[0, 0]),
    "maccullagh": lambda J: li.potentials.maccullagh(1.0, np.ones(2), [J, J]),
    "mutual_gravity": lambda J: li.potentials.mutual_gravity(1.0, [J, J]),
    "pseudo_rigid_body": lambda J: systems.pseudo_rigid_body(J, jnp.trace),
    "incompressible_body": lambda J: systems.incompressible_body(J, jnp.trace),
    "body": lambda J: shapes.body(mass=1.0, inertia=J),
}


@pytest.mark.parametrize("name", TAKING_INERTIA)
def test_a_system_or_a_law_is_no_inertia(name):
    """It has an attribute of that name, but its potential, rotor and torques would be lost; a shape has no more."""
    take = TAKING_INERTIA[name]
    for other in (li.systems.heavy_top([1.0, 1.0, 0.4], [0, 0, 0.3]), li.torques.kane_damper(0.1, 0.1)):
        with pytest.raises(ValueError, match=r"must (be|hold)"):
            take(other)
    assert np.all(np.isfinite(jax.tree.leaves(take(shapes.ellipsoid([1.0, 1.1, 1.2], mass=2.0)))[0]))


def test_a_top_with_friction_is_made_as_the_error_says():
    """With the weight as a law of torque its motion is that of the top: the vector fields agree to round-off."""
    weight, J = jnp.array([0.1, -0.2, 0.3]), [1.0, 1.2, 0.6]
    top = li.systems.heavy_top(J, weight)
    with pytest.raises(ValueError, match=r"torqued_body\(top\.inertia, .* torques\.potential\(V, axis\)"):
        li.systems.torqued_body(top, li.torques.viscous(0.1))
    law = li.torques.viscous(0.0) + li.torques.potential(lambda Gamma, t: weight @ Gamma, [0.0, 0.0, 1.0])
    body = li.systems.torqued_body(top.inertia, law)
    motion = dict(attitude=np.array([0.8, -0.4, 0.4, 0.2]), angular_velocity=[0.3, 0.5, -0.2])
    found, exact = body.vector_field(body.state(**motion)), top.vector_field(top.state(**motion))
    np.testing.assert_allclose(found.p, exact.p, rtol=0, atol=1e-15)
    assert np.abs(exact.p).max() > 0.05


def test_an_elastic_body_takes_the_second_moments_of_a_shape():
    """E = ∫ X⊗X dm, (m r²/5)·1 of a ball, where its inertia is (2m r²/5)·1."""
    ball = shapes.ellipsoid([2.0, 2.0, 2.0], mass=5.0)
    for make in (li.systems.pseudo_rigid_body, li.systems.incompressible_body):
        np.testing.assert_allclose(make(ball, jnp.trace).inertia, 4 * np.eye(3), rtol=1e-15)


@pytest.mark.long
def test_inertia_integrals_of_the_moon_of_1999_kw4_are_those_of_gubas():
    """∫ xˡyᵐzⁿ dm about the origin to order 4, and the moments of inertia, which GUBAS published for this polyhedron.

    meyeralexj/gubas @f815438: kw4b_p_fixm.csv, kw4b_tri.csv, TDS_4.csv and IDS.csv; kg and km, 15 digits. Observed
    2e-15, 7e-15 and 2e-15 of the largest of each order, and of the primary 7e-15, 2.3e-14 and 5e-15.
    """
    data = np.load(Path(__file__).parents[1] / "data" / "kw4-beta-gubas.npz")
    published = data["integrals"]
    body = shapes.mesh(data["vertices"] / 1000, data["faces"].astype(int), mass=published[0, 0, 0])
    moments = shapes._solids._shift_moments(body._about_center(), body.center)
    for order in (2, 3, 4):
        powers = [k for k in itertools.product(range(order + 1), repeat=3) if sum(k) == order]
        ours = [moments[order][(0,) * a + (1,) * b + (2,) * c] for a, b, c in powers]
        theirs = np.array([published[k] for k in powers])
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-14 * np.abs(theirs).max())
    squares = np.diag(moments[2])
    np.testing.assert_allclose(squares.sum() - squares, data["moments"], rtol=1e-13)


def test_a_shape_prints_its_mass_and_inertia_and_not_its_faces():
    vertices, faces = np.eye(4, 3, -1), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    text = repr(li.shapes.mesh(vertices, faces, mass=2.0))
    assert text.startswith("Shape(mass=2., center=[0.25, 0.25, 0.25], inertia=[[")
    assert text.endswith("triangles=float64[4, 3, 3])")
    inside = []
    jax.make_jaxpr(lambda m: inside.append(repr(li.shapes.box([1.0, 2.0, 3.0], mass=m))))(1.0)
    assert inside == ["Shape(mass=float64[], center=float64[3], second=float64[3, 3], radius=float64[])"]
