"""Gravity of polyhedra: closed forms, tetrahedra cut fine, derivatives, hollows, and orbits close to the surface."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from test_shapes import CUBE, FACES, sphere

import lieint_jax as li
from lieint_jax import potentials, shapes
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

RNG = np.random.default_rng(10)
OFF_EDGES = [(0.9, 0.2, 0.4), (-0.6, 0.1, -0.8), (-0.7, 0.1, 0.5)]
POINTS = np.concatenate([RNG.uniform(-0.4, 1.4, (12, 3)), [[3.0, -2.0, 5.0], [0.5, 0.5, 0.5]]])


def bilobed(levels):
    """A contact binary of two lobes, like (4769) Castalia: vertices and faces."""
    at, faces = sphere(levels)
    x, _, z = at.T
    return at * (0.55 + 0.45 * x**2 + 0.06 * x - 0.05 * z**2 + 0.03 * np.sin(5 * x + 3 * z))[:, None], faces


@functools.cache
def stone(levels=2):
    at, faces = bilobed(levels)
    return shapes.mesh(at + np.array([0.2, -0.1, 0.3]), faces, density=1.5)


@functools.cache
def cube(dtype=float):
    return potentials.polyhedron(jnp.array(2.0, dtype), (jnp.array(CUBE, dtype), FACES), jnp.array(1.5, dtype))


def of_box(point):
    """φ and the force of the unit cube at density 1 and G = 1, by MacMillan's and Nagy's sums over corners."""
    with mpmath.workdps(40):
        log, atan = mpmath.log, mpmath.atan
        total = [mpmath.mpf(0)] * 4
        for corner in itertools.product((0, 1), repeat=3):
            x, y, z = (mpmath.mpf(c) - mpmath.mpf(float(p)) for c, p in zip(corner, point, strict=True))
            r = mpmath.sqrt(x * x + y * y + z * z)
            X, Y, Z = (log(u + r) for u in (x, y, z))
            A, B, C = atan(y * z / (x * r)), atan(z * x / (y * r)), atan(x * y / (z * r))
            terms = [x * y * Z + y * z * X + z * x * Y - (x * x * A + y * y * B + z * z * C) / 2]
            terms += [y * Z + z * Y - x * A, z * X + x * Z - y * B, x * Y + y * X - z * C]
            sign = (-1) ** (1 + sum(corner))
            total = [s + sign * t for s, t in zip(total, terms, strict=True)]
        return -float(total[0]), [-float(x) for x in total[1:]]


@pytest.mark.quick
def test_a_cube_has_the_potential_and_the_force_of_its_closed_form():
    V, F = (np.array(x) for x in zip(*map(of_box, POINTS), strict=True))
    np.testing.assert_allclose(cube().value(POINTS), 3 * V, rtol=1e-13)
    np.testing.assert_allclose(cube().force(POINTS), 3 * F, rtol=0, atol=1e-13 * 3 * np.abs(F).max())


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_force_close_to_an_edge_or_a_vertex_has_all_digits(dtype):
    """The distances of an edge's ends, less its length, cancel there: the error was eps over the distance."""
    depths = 10.0 ** np.arange(-2, -9 if dtype == np.float64 else -6, -1)
    points = [corner + d * np.array(way) for corner in ([1, 0.3, 1], [1, 1, 1]) for d in depths for way in OFF_EDGES]
    points = np.array(points, dtype)
    F = np.array([of_box(point)[1] for point in points])
    found = np.asarray(cube(dtype).force(points), float)
    assert np.abs(found - 3 * F).max() < 8 * np.finfo(dtype).eps * 3 * np.abs(F).max()  # observed: 2.6 eps


@pytest.mark.quick
def test_second_derivatives_are_those_of_the_force_and_find_the_inside():
    """By Poisson's equation the trace is 4πGρ inside and 0 outside."""
    P, h = cube(), 1e-4
    found = np.asarray(P.hessian(POINTS))
    inside = np.all((POINTS > 0) & (POINTS < 1), axis=1)
    assert 1 < inside.sum() < len(POINTS) - 1
    np.testing.assert_allclose(P.laplacian(POINTS), 12 * np.pi * inside, rtol=0, atol=3e-14 * 12 * np.pi)
    moved = (POINTS + s * h * e for e in np.eye(3) for s in (1, -1))
    F = np.asarray(P.force(np.stack(list(moved)))).reshape(3, 2, -1, 3)
    np.testing.assert_allclose(found, np.moveaxis(F[:, 1] - F[:, 0], 0, 1) / (2 * h), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))


def test_autodiff_finds_the_closed_forms():
    """Of φ, of the force, and of second derivatives against differences, forward and in reverse."""
    P, x, h = cube(), jnp.array(POINTS[:6]), 1e-5
    np.testing.assert_allclose(jax.vmap(jax.grad(P.value))(x), -jax.vmap(P.force)(x), rtol=1e-15)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.vmap(derivative(P.force))(x), -P.hessian(x), rtol=1e-14, atol=1e-14)
    slopes = jax.vmap(jax.jacrev(P.hessian))(x)
    near = [(P.hessian(x + h * e) - P.hessian(x - h * e)) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(slopes, jnp.stack(near, axis=-1), rtol=1e-6, atol=1e-6 * float(jnp.abs(slopes).max()))
    fourth = jax.jacfwd(jax.jacfwd(P.hessian))(x[0])
    np.testing.assert_allclose(fourth, jnp.swapaxes(fourth, 0, 3), rtol=0, atol=1e-12 * float(jnp.abs(fourth).max()))


def test_derivatives_by_vertices_and_by_the_density():
    at, faces, x, h = jnp.array(CUBE), FACES, jnp.array(POINTS[0]), 1e-4

    def pull(shift, density):
        return potentials.polyhedron(2.0, (at.at[7, 1].add(shift), faces), density).force(x)[0]

    for way in (jax.jacfwd, jax.jacrev):
        slope = jax.jit(way(pull, (0, 1)))(0.1, 1.5)
        assert float(slope[0]) == pytest.approx(float(pull(0.1 + h, 1.5) - pull(0.1 - h, 1.5)) / (2 * h), rel=1e-6)
        assert float(slope[1]) == pytest.approx(float(pull(0.1, 1.0)), rel=1e-13, abs=0)


@pytest.mark.quick
@pytest.mark.parametrize("place", [[1.0, 0.3, 1.0], [1.0, 1.0, 1.0], [1.0, 0.3, 0.6], [2.0, 1.0, 1.0], [2.0, 0.3, 1.0]])
def test_phi_and_the_force_are_continuous_at_edges_vertices_and_faces_and_on_lines_of_edges(place):
    P, x = cube(), np.array(place)
    near = x + 1e-9 * RNG.normal(size=(5, 3))
    np.testing.assert_allclose(P.value(near), np.full(5, P.value(x)), rtol=1e-7)
    np.testing.assert_allclose(P.force(near), np.tile(P.force(x), (5, 1)), rtol=0, atol=1e-6)
    assert np.isfinite(P.hessian(x)).all()


@pytest.mark.quick
def test_a_facet_without_area_contributes_nothing():
    """Its normal is rounding, which was not normal to its edges: the force was wrong by 1 %."""
    at, faces = np.random.default_rng(3).normal(size=(4, 3)), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    x = jnp.array([[0.7, 1.1, 0.3], [2.0, -1.0, 0.5]])
    plain = potentials.polyhedron(1.0, (at, faces), 1.0)
    for height in (0.0, 1e-15):  # of a vertex over an edge
        split = np.concatenate([at, [0.4 * at[0] + 0.6 * at[1] + height * np.array([0.3, 0.4, -0.5])]])
        found = potentials.polyhedron(1.0, (split, [[0, 2, 4], [4, 2, 1], [0, 4, 1], *faces[1:]]), 1.0)
        for name in ("value", "force", "hessian"):
            expected = getattr(plain, name)(x)
            close = 1e-14 * float(jnp.abs(expected).max())  # observed: 1e-15
            np.testing.assert_allclose(getattr(found, name)(x), expected, rtol=0, atol=close)


def by_tetrahedra(shape, x, order=10):
    """The force at density 1 and G = 1 by quadrature within tetrahedra, cut in halves until they are small from x."""
    corners = np.asarray(shape.triangles)
    pending = np.concatenate([corners, np.full((len(corners), 1, 3), shape.center)], axis=1)
    (u, w), force = np.polynomial.legendre.leggauss(order), np.zeros(3)
    u, w = (u + 1) / 2, w / 2
    r, s, t = (g.ravel() for g in np.meshgrid(u, u, u, indexing="ij"))
    weight = np.einsum("i,j,k->ijk", w, w, w).ravel() * r * r * s
    bary = np.stack([1 - r, r * (1 - s), r * s * (1 - t), r * s * t], axis=1)
    pairs = np.array(list(itertools.combinations(range(4), 2)))
    while len(pending):
        lengths = np.linalg.norm(pending[:, pairs[:, 0]] - pending[:, pairs[:, 1]], axis=2)
        far = np.linalg.norm(pending.mean(axis=1) - x, axis=1) > 1.5 * lengths.max(axis=1)
        volumes = np.linalg.det(pending[far, 1:] - pending[far, :1])
        for tetrahedron, volume in zip(pending[far], volumes, strict=True):
            d = bary @ tetrahedron - x
            force += volume * (weight / np.linalg.norm(d, axis=1) ** 3) @ d
        pending, longest = pending[~far], pairs[np.argmax(lengths[~far], axis=1)]
        rows = np.arange(len(pending))
        middle = (pending[rows, longest[:, 0]] + pending[rows, longest[:, 1]]) / 2
        halves = [pending.copy(), pending.copy()]
        for half, end in zip(halves, longest.T, strict=True):
            half[rows, end] = middle
        pending = np.concatenate(halves)
    return -force  # the center is the last corner


def test_a_bilobed_body_attracts_as_its_tetrahedra_close_to_the_surface():
    """At 0.1 of its radius above the surface, in the waist and at the ends."""
    shape = stone()
    P = potentials.polyhedron(1.0, shape, density=1.0)
    for face in (3, 40, 77, 120):
        a, b, c = np.asarray(shape.triangles[face])
        normal = np.cross(b - a, c - a)
        x = (a + b + c) / 3 + 0.1 * normal / np.linalg.norm(normal)
        exact = by_tetrahedra(shape, x)
        assert float(jnp.abs(P.laplacian(x))) < 1e-12
        np.testing.assert_allclose(P.force(x), exact, rtol=0, atol=1e-12 * np.linalg.norm(exact))


def test_round_polyhedra_attract_as_spheres_to_second_order_and_shells_have_no_field_inside():
    """A cavity of the mesh is exactly the difference of two polyhedra; its field is 0 up to the mesh's error."""
    errors, fields = [], []
    for levels in (3, 4):
        at, faces = sphere(levels)
        P = potentials.polyhedron(1.0, (at, faces), 1.0)
        x = jnp.array([[1.2, 0.9, -0.4], [0.0, 1.6, 0.3]])
        errors.append(float(jnp.abs(P.value(x) + P.mass / jnp.linalg.norm(x, axis=1)).max()))
        hollow = (np.concatenate([at, 0.5 * at]), np.concatenate([faces, faces[:, ::-1] + len(at)]))
        shell, inner = potentials.polyhedron(1.0, hollow, 1.0), potentials.polyhedron(1.0, (0.5 * at, faces), 1.0)
        y = jnp.array([0.1, -0.2, 0.15])
        fields.append(float(jnp.abs(shell.force(y)).max()))
        np.testing.assert_allclose(shell.force(y), P.force(y) - inner.force(y), rtol=0, atol=1e-14)
        assert abs(float(shell.laplacian(y))) < 1e-13
    for found in (errors, fields):
        assert np.log2(found[0] / found[1]) == pytest.approx(2, abs=0.1), found


def test_two_parts_of_one_mesh_attract_as_their_sum():
    at, faces = bilobed(1)
    two = (np.concatenate([at, at + np.array([3.0, 0, 0])]), np.concatenate([faces, faces + len(at)]))
    dumbbell, one = (potentials.polyhedron(1.0, mesh, 1.0) for mesh in (two, (at, faces)))
    x = jnp.array(POINTS)
    both = one.force(x) + one.force(x - jnp.array([3.0, 0, 0]))
    np.testing.assert_allclose(dumbbell.force(x), both, rtol=0, atol=1e-13)


@pytest.mark.parametrize("turned", ["moved", "aligned", "reversed"])
def test_a_shape_keeps_its_mesh(turned):
    """Where it is moved or aligned, and whichever way its faces are oriented; a sum has none."""
    at, faces = bilobed(0)
    shape = shapes.mesh(at, faces, density=1.5)
    R, by = np.eye(3), np.zeros(3)
    if turned == "moved":
        R, by = np.asarray(so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))), np.array([1.0, 2.0, 3.0])
        other = shape.moved(by, R)
    elif turned == "aligned":
        R, other = np.asarray(shape.principal_axes()[1].T), shape.aligned()
        by = -R @ np.asarray(shape.center)
    else:
        other = shapes.mesh(at, faces[:, ::-1], density=1.5)
    corners = shape.triangles.sum(axis=1) @ R.T + 3 * by
    np.testing.assert_allclose(other.triangles.sum(axis=1), corners, rtol=0, atol=1e-13)
    x = np.array([0.9, 0.8, -0.7])
    P, Q = (potentials.polyhedron(1.0, s) for s in (shape, other))
    np.testing.assert_allclose(Q.force(R @ x + by), R @ P.force(x), rtol=1e-12)
    assert float(Q.density) == pytest.approx(1.5, rel=1e-14, abs=0)
    assert (shape + other).triangles is None


@functools.cache
def pair(levels=1, small=None, shape=None):
    """A bilobed body that rotates, and a pebble, or a small body, on an orbit close to it, against the rotation."""
    shape = shape or stone(levels)
    P = potentials.polyhedron(1.0, shape)
    m = float(P.mass)
    J = jnp.stack([shape.inertia, 1e-6 * jnp.eye(3) if small is None else jnp.array(small)])
    system = li.systems.rigid_bodies([m, 1e-3], J, P)
    v = 1.02 * np.sqrt(m / 1.5)
    state = system.state(
        [[0.0, 0, 0], [1.5, 0, 0.1]],
        velocities=[[0.0, -1e-3 * v / m, 0], [0.0, v, 0.1]],
        angular_velocities=[[0.02, 0.0, -0.5], [0.3, 0.2, 0.4]],
    )
    return system, state


TILTED = np.array([[3.0, 0.4, -0.2], [0.4, 2.0, 0.3], [-0.2, 0.3, 2.5]]) * 1e-6


@pytest.mark.parametrize("small", ["pebble", "body"])
def test_forces_and_torques_are_the_derivative_of_the_potential(small):
    system, state = pair(small=None if small == "pebble" else tuple(map(tuple, TILTED)))
    R = jnp.stack([so3.to_matrix(so3.exp(jnp.array(axis))) for axis in ([0.3, -0.5, 0.4], [1.0, 0.2, -0.7])])
    x, V = state.q[:, :3], system.potential
    force, (along_x, along_R) = jax.jit(lambda x, R: (V.force(x, R), jax.grad(V, (0, 1))(x, R)))(x, R)
    expected = jnp.concatenate([-along_x, potentials.torques(R, along_R)], axis=1)
    np.testing.assert_allclose(force, expected, rtol=0, atol=2e-14 * float(jnp.abs(expected).max()))
    assert bool(jnp.any(force[1, 3:] != 0)) == (small == "body")


def test_the_shape_of_a_small_body_counts_to_second_order():
    """Against its points, which are symmetric about its center: the error falls as the fourth power of its size."""
    points, masses = np.array([[1.0, 0.2, 0], [0, 0.7, 0.3], [0.1, 0, 0.4]]), np.array([1.0, 2.0, 1.5]) / 9
    small, weights = np.concatenate([points, -points]), np.concatenate([masses, masses])
    P, x = potentials.polyhedron(1.0, stone(1)), jnp.array([[0.0, 0, 0], [1.2, 0.3, 0.5]])
    turns = jnp.stack([so3.to_matrix(so3.exp(jnp.array(a))) for a in ([0.3, -0.5, 0.4], [1.0, 0.2, -0.7])])
    errors, parts = [], []
    for size in (0.1, 0.05):
        body = shapes.sites(weights, size * small)
        bodies = li.systems.rigid_bodies([P.mass, 1.0], jnp.stack([stone(1).inertia, body.inertia]), P)
        places = (x[1] - x[0] + size * small @ turns[1].T) @ turns[0] + P.center
        exact = float(jnp.sum(weights * P.value(places)))
        parts.append(abs(exact - float(P.value((x[1] - x[0]) @ turns[0] + P.center))))
        errors.append(abs(exact - float(bodies.potential(x, turns))))
    assert np.log2(parts[0] / parts[1]) == pytest.approx(2, abs=0.1)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)


def conserved(scheme, steps, small=None, levels=1):
    """The largest errors of energy, P and L, relative to their sizes."""
    system, state = pair(levels, small)
    step = getattr(li.schemes, scheme)(system)
    run = li.Run.of(step, li.integrate(step, state, 0.01, steps, save_every=max(1, steps // 50)))
    assert run.info.converged.all()
    distances = jnp.linalg.norm(run.state.q[:, 1, :3] - run.state.q[:, 0, :3], axis=1)
    assert float(distances.min()) > 1.0
    H = float(jnp.abs(run.energy_error()).max() / 1e-3)  # of a unit mass, φ is about 1
    moved = jnp.abs(run.momentum_error()).max(axis=0)
    p, L = float(jnp.abs(run.state.p[..., :3]).max()), float(jnp.abs(system.momentum(state)[3:]).max())
    return H, float(moved[:3].max()) / p, float(moved[3:].max()) / L


@pytest.mark.parametrize(
    ("scheme", "steps"), [("splitting", 300), ("splitting", 100_000), ("bodies_energy_momentum", 300)]
)
def test_a_pebble_in_orbit_close_to_a_bilobed_body(scheme, steps):
    """Both momenta to round-off; the energy to round-off by the energy–momentum scheme, bounded by splitting."""
    H, P, L = conserved(scheme, steps)
    assert 1e-15 * steps > P
    assert 1e-15 * steps > L
    assert H < 1e-12 if scheme == "bodies_energy_momentum" else 1e-7 < H < 1e-3


def test_a_small_body_of_any_shape_conserves_energy_and_both_momenta():
    H, P, L = conserved("bodies_energy_momentum", 100, tuple(map(tuple, 1e3 * TILTED)))
    assert max(H, P, L) < 1e-12


def test_the_derivative_through_a_step_agrees_with_differences():
    system, state = pair(1)
    step, h = li.schemes.splitting(system), 1e-4

    @jax.jit
    def end(shift):
        return step(state._replace(q=state.q.at[1, 0].add(shift)), 0.05)[0].p[1]

    slope = jax.jit(jax.jacfwd(end))(0.0)
    np.testing.assert_allclose(slope, (end(h) - end(-h)) / (2 * h), rtol=0, atol=1e-6 * float(jnp.abs(slope).max()))


def test_machine_code_reads_the_faces_from_memory_and_agrees_with_xla():
    system, state = pair(2)
    step = li.schemes.splitting(system)

    def end(state):
        return li.integrate(step, state, 0.01, 20, save_every=20).state.q

    states = jax.tree.map(lambda z: jnp.stack([z, z]), state)
    states = states._replace(q=states.q.at[1, 1, 0].add(0.1))
    found = {}
    for engine in ("native", "xla"):
        with li.engine(engine):
            assert li.explain(jax.vmap(end), states).engines == {engine}
            found[engine] = jax.jit(lambda z: jax.vmap(end)(z))(states)
    np.testing.assert_allclose(found["native"], found["xla"], rtol=0, atol=1e-14)


def test_single_precision():
    """Close to the surface a few eps; the error grows with the square of the distance."""
    P = cube(np.float32)
    x = np.asarray(POINTS, np.float32)
    assert P.value(x).dtype == P.force(x).dtype == np.float32
    exact = cube().force(x.astype(float))
    np.testing.assert_allclose(P.force(x), exact, rtol=0, atol=2e-5 * float(jnp.abs(exact).max()))
    for unit in (1e-10, 1e9):  # an asteroid in au, whose squared areas are less than the least number, and a star in m
        corners = (unit * np.array(CUBE)).astype(np.float32)
        found = potentials.polyhedron(np.float32(2), (corners, FACES), np.float32(1.5)).force(np.float32(unit) * x)
        np.testing.assert_allclose(found / unit, exact, rtol=0, atol=2e-5 * float(jnp.abs(exact).max()))


def test_a_step_into_another_s_enclosing_sphere_is_flagged():
    long = shapes.ellipsoid([2.0, 1.0, 1.0], mass=1.0)
    bodies = li.systems.rigid_bodies([1.0, 0.1], [[1.0, 1, 1]] * 2, potentials.mutual_gravity(1.0, [long, 0.1]))
    state = bodies.state([[0, 0, 0], [2.1, 0, 0]], velocities=[[0, 0, 0], [-2.0, 0, 0]])
    for scheme in (li.schemes.splitting, li.schemes.bodies_energy_momentum):
        assert not scheme(bodies)(state, 0.1)[1].converged


@pytest.mark.quick
@pytest.mark.parametrize(
    ("shape", "radius"),
    [
        (shapes.box([2.0, 4.0, 4.0], mass=1.0), 3.0),
        (shapes.cylinder(3.0, 8.0, mass=1.0), 5.0),
        (shapes.sites([1.0, 1.0], [[0.0, 0, 0], [2.0, 0, 0]]), 1.0),
        (shapes.ellipsoid([1.0, 1, 1], mass=1.0).moved([2.0, 0, 0]) + shapes.ellipsoid([1.0, 1, 1], mass=1.0), 2.0),
        (shapes.mesh(CUBE, FACES, mass=1.0), np.sqrt(0.75)),
    ],
)
def test_the_radius_of_the_enclosing_sphere(shape, radius):
    assert float(shape.radius) == pytest.approx(radius, rel=1e-14, abs=0)
