"""Calls with bad arguments, room by room, and the sentence of their errors: what was given, allowed, to be done.

`tests/schemes/test_accepted_systems.py` has every scheme with every system that it does not accept. Errors of commands
and files, and those of a run, are in the tests of these.
"""

import datetime
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cubes import CUBE, FACES
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import groups, maps, orbits, potentials, schemes, shapes, systems, tides, torques
from lieint_jax.dates import epoch
from lieint_jax.schemes import additive, compose, gauss, group_midpoint, nystrom, splitting
from lieint_jax.systems import damped_body, gyrostat, potential_top, rigid_bodies, torqued_body

J, ONE, EYE, E3 = np.array([1.0, 2.0, 2.7]), np.array([1.0, 0, 0, 0]), np.eye(3), [0.0, 0, 1]
BODY, OTHER = systems.rigid_body([1.0, 2.0, 3.0]), systems.rigid_body([1.0, 2.0, 2.6])
TOP = systems.heavy_top(J, [0.3, -0.2, 1.0])
FIELD_TOP = potential_top(J, lambda R: R[0, 0], None)
WELLS = systems.driven_top(J, lambda R, t: jnp.cos(t) * R[0, 0], None)
SPIN = [0.1, 0.2, 1.0]
MOTIONS = "angular_velocity, body_momentum, spatial_momentum"


def field(t):
    return jnp.stack([jnp.sin(t), 0.4 * jnp.ones_like(t), jnp.cos(2 * t)])


def spin(t, q, omega):
    return 0.1 * omega


def rows(call, message, *values):
    """One row for each value of an argument."""
    return [(lambda value=value: call(value), message) for value in values]


SUN, PLATE = np.array([0.0, 0.6, 0.8]), ([0.6, 0.0, 0.8], [0.3, -0.2, 0.9])
DAMPER = torques.kane_damper(0.2, 0.1)
WHEELS = torques.wheels([[1.0, 0, 0], [0, 1.0, 0], [0.6, 0, 0.8]], [0.05, 0.04, 0.06])
VISCOUS_TORQUE = torques.viscous(0.1)


def lacking(law, **replaced):
    """A run of a torqued body whose starting state has other parts."""
    body = torqued_body(J, law)
    state = body.state(angular_velocity=SPIN, work=0.0)._replace(**replaced)
    li.integrate(schemes.torqued_midpoint(body), state, 0.1, 1)


LAWS = [
    (lambda: lacking(VISCOUS_TORQUE, t=None), r"that counts work needs a time .*state\._replace\(t=0.0\)"),
    (lambda: lacking(VISCOUS_TORQUE, t=None, work=None), r"time: make it with system\.state\(\.\.\., t=0.0\)"),
    (lambda: lacking(VISCOUS_TORQUE, t=jnp.array(np.nan)), r"state\.t must be finite"),
    (lambda: lacking(VISCOUS_TORQUE, work=jnp.array(np.inf)), r"state\.work must be finite"),
    (lambda: lacking(VISCOUS_TORQUE, work=jnp.zeros(2)), r"state\.work must have shape \(\)"),
    (lambda: lacking(DAMPER, extra=None), r'KaneDamper has an internal state, State\.extra\["damper"\]'),
    (lambda: lacking(DAMPER, extra={"damper": jnp.zeros(2)}), r'extra\["damper"\] must have shape \(3,\)'),
    (lambda: lacking(DAMPER, extra={"damper": np.full(3, np.nan)}), r'extra\["damper"\] must be finite'),
    (lambda: torqued_body(J, lambda t, q, w: q), r"numbers of shape \(3,\), got shape \(4,\)"),
    (lambda: torqued_body(J, lambda t, q, w: 0.0), r"of shape \(3,\), got shape \(\)"),
    (lambda: torqued_body(J, lambda t, q, w: 1j * w), r"real numbers .* dtype complex128"),
    (lambda: torqued_body(J, lambda t, q, w: list(w)), r"must return an array of real numbers"),
    (lambda: torqued_body(J, lambda t, q, w: None), r"must return an array of real numbers"),
    (lambda: torqued_body(J, E3), r"torque must be a function of \(t, q, omega\)"),
    (lambda: torqued_body(J, lambda t, q: q[1:]), "torque fails as a function of t .* positional"),
    (lambda: torqued_body(J, lambda t, q, w: w @ q), "torque fails as a function of t"),
    (lambda: torqued_body(J, spin, "inertial"), '"body" or "space", got .inertial.'),
    (lambda: torqued_body(J, torques.viscous(0.1), "space"), 'must be "body", the axes of Viscous, got .space.'),
    (lambda: torqued_body([1.0, 0.0, 1.0], spin), "inertia must be positive definite"),
    *rows(torques.viscous, "damping must not be negative", -0.1, [0.1, -0.1, 0.2]),
    (lambda: torques.viscous(np.diag(J) + np.eye(3, k=1)), "damping must be symmetric"),
    (lambda: torques.viscous([0.1, 0.2]), r"damping must have shape \(\) or \(3,\) or \(3, 3\)"),
    (lambda: torques.viscous(np.nan), "damping must be finite"),
    (lambda: torques.pd_trace(-1.0, 0.2), "gain must not be negative, got -1"),
    (lambda: torques.pd_quaternion(1.0, -0.2), "damping must not be negative, got -0.2"),
    (lambda: torques.pd_quaternion(1.0, 0.2, [1.0, 1.0, 0, 0]), "target must be a unit quaternion"),
    (lambda: torques.bdot(-1.0, field), "gain must not be negative"),
    (lambda: torques.bdot(1.0, [0.0, 1.0]), r"field must have shape \(3,\), got \(2,\)"),
    (lambda: torques.kane_damper(0.0, 0.1), "inertia must be positive, got 0"),
    (lambda: torques.kane_damper(0.1, -0.1), "damping must not be negative"),
    (lambda: torques.thruster(E3, 2.0, 1.0), "must not stop before it starts, got start = 2"),
    (lambda: torques.thruster([0, 1.0], 1.0, 2.0), r"torque must have shape \(3,\)"),
    (lambda: torques.solar_plate(1.0, [0, 0, 2.0], PLATE[1], SUN), "normal must be a unit vector"),
    (lambda: torques.solar_plate(1.0, *PLATE, [0, 1.0, 1.0]), "sun must be a unit vector"),
    (lambda: torques.solar_plate(1.0, *PLATE, SUN, specular=0.7, diffuse=0.5), "must be at most 1"),
    (lambda: torques.solar_plate(-1.0, *PLATE, SUN), "force must not be negative"),
    (lambda: damped_body(J, -0.1), "friction must not be negative, got -0.1: it would give energy"),
    (lambda: damped_body(J, [0.1, 0.1]), r"friction must have shape \(\)"),
    (lambda: schemes.torqued_midpoint(torqued_body(J, spin), 1.0), "kappa"),
    (lambda: schemes.torqued_midpoint(torqued_body(J, spin), iterations=0), "iterations must be an integer ≥ 1"),
    (lambda: DAMPER + torques.kane_damper(0.1, 0.1), "the same key .damper. .* give one of them"),
    (lambda: torques.total([3.0]), "torque must be a function of"),
    (lambda: torqued_body(J, [torques.viscous(0.1)]), r"a sum of laws, such as a \+ b or torques\.total\(\[a, b\]\)"),
    (lambda: torques.wheels([[1.0, 1.0, 0]], 0.1), "axes must be unit vectors"),
    (lambda: torques.wheels([1.0, 0, 0], 0.1), r"axes must have shape \(m, 3\)"),
    (lambda: torques.wheels(WHEELS.axes, [0.1, 0.2]), r"inertias must have shape \(\) or \(3,\)"),
    (lambda: torques.wheels(WHEELS.axes, -0.1), "inertias must be positive"),
    (lambda: torques.wheels(WHEELS.axes, 0.1, lambda t, q, w, h: w[:2]), r"motor must be a function of t, q"),
    (lambda: torques.wheels(WHEELS.axes, 0.1, lambda t, q, w, h: w @ h @ q), "motor must be a function .* it fails"),
    (lambda: torques.saturated(WHEELS, 0.1), "give wheels a max_torque"),
    (lambda: torques.saturated(torques.viscous(0.1), 0.0), "limit must be positive"),
    (lambda: torques.saturated(torques.viscous(0.1) + spin, 0.1), "do so to each of its laws"),
    (lambda: torques.windowed(torques.sampled(spin, 0.1), 0.0), "do so to the law that it samples"),
    (lambda: torques.windowed(spin, 2.0, 1.0), "must not stop before it starts"),
    (lambda: torques.dipole(E3, lambda t: t), "field must be a function of the time t"),
    (lambda: torques.bdot(1.0, lambda t: {}["b"]), "field must be a function .* fails: KeyError"),
    (lambda: torques.gravity_gradient(lambda t: 1 / 0, J, 1.0), "fails: ZeroDivisionError"),
    (lambda: torques.gravity_gradient(lambda t: (field(t), field(t)), J), "this orbit has no mu"),
    (lambda: torques.potential(lambda G, t: G, field), "V must be a function of Gamma"),
    (lambda: torques.body_inertia([0.05, 1, 1.0], [[1.0, 0, 0]], 0.06), "inertia must be positive"),
    *rows(
        lambda x: torques.eddy_current(x, field), "tensor must not be negative", -0.1, [1, -1, 2], np.diag([1, 1, -1])
    ),
    (lambda: torques.eddy_current(np.triu(np.ones((3, 3))), field), "tensor must be symmetric"),
    (lambda: torques.eddy_current(0.1, [1.0, 0.0]), "field must have shape"),
    (lambda: torques.sampled(WHEELS, 0.1), r"Wheels has State\.extra"),
    (lambda: torques.sampled(torques.viscous(0.1), 0.0), "period must be"),
]


def circle(t):
    c, s = jnp.cos(t), jnp.sin(t)
    return jnp.stack([c, s, 0 * t]), jnp.stack([-s, c, 0 * t])


AIR, BOX = orbits.atmosphere(circle, 0.3, 0.1, 0.1, radius=0.8, rate=0.06), torques.box_plates([1.0, 0.5, 0.4])
AXES, FACE = torques.wheel_pyramid(), [[0.0, 0, 1]]
SATELLITES = [
    (lambda: torqued_body(J, torques.unloading(AXES, 0.1, field, 0.2)), "reads State.extra.*add the law with that"),
    (lambda: torques.aerodynamic(lambda t: t, *BOX), "air must be a function of the time t"),
    (lambda: torques.aerodynamic(AIR, 1.0, E3, E3), r"arms must have shape \(m, 3\)"),
    (lambda: torques.aerodynamic(AIR, 1.0, [[0.0, 1, 1]], FACE), "normals must be unit vectors"),
    (lambda: torques.aerodynamic(AIR, -1.0, FACE, FACE), "areas must not be negative"),
    (lambda: torques.solar_plates(*BOX, SUN, specular=0.9, diffuse=0.2), "must be at most 1"),
    (lambda: torques.solar_plates(*BOX, SUN, light=lambda t: SUN), "light must be a function"),
    (lambda: torques.allocation([[1.0, 0, 0], [0, 1.0, 0]]), "axes must span all directions"),
    (lambda: torques.wheel_pyramid(wheels=2), "wheels must be an integer ≥ 3"),
    (lambda: torques.wheel_motor(AXES, WHEELS), "control law must not have an internal state"),
    (lambda: torques.pointing(lambda t: SUN, 1.0, 1.0), "frame must be a function of the time t"),
    (lambda: torques.pointing([2.0, 0, 0, 0], 1.0, 1.0), "frame must be a unit quaternion"),
    (lambda: torques.sliding_mode(orbits.lvlh(circle), J, 1.0, 1.0, layer=0.0), "layer must be positive"),
]
LOW, FLYBY = orbits.kepler(orbits.EARTH_GM, 6878.137, 0.001, 0.9), orbits.kepler(398600.4418, -28400.0, 2.35)
DAY, NAN_LAST = 2460676.5, np.array([[0.0] * 3, [0.0] * 3, [0.0, np.nan, 0.0]])


def traced(*elements):
    """A Kepler orbit of these elements, and of one that is traced."""
    jax.eval_shape(lambda x: orbits.kepler(*(x if y is None else y for y in elements)), 1.0)


ORBITS = [
    (lambda: orbits.from_state(0.0, [1.0, 0, 0], [0, 1.0, 0]), "mu must be positive"),
    (lambda: orbits.from_state(1.0, [0.0, 0, 0], [0, 1.0, 0]), "position must not be that of the center"),
    (lambda: orbits.from_state(1.0, [1.0, 0, 0], [2.0, 0, 0]), "must not be a line through the center"),
    (lambda: orbits.from_state(1.0, [1.0, 0, 0], [0, 2**0.5, 0]), "the orbit is a parabola"),
    (lambda: orbits.table([0.0, 1, 1], EYE, EYE), "times must increase.*1 and 2"),
    (lambda: orbits.table([0.0], EYE[:1], EYE[:1]), "with n ≥ 2"),
    (lambda: orbits.table([0.0, 1], EYE, EYE[:2]), "positions must have shape"),
    (
        lambda: orbits.table([0.0, 1, 2], EYE + NAN_LAST, EYE),
        "^positions must be finite, got nan in entry 2, component 1$",
    ),
    (lambda: orbits.secular_j2(orbits.EARTH_GM, 6700.0, 0.1, 1.0), "the periapsis is below the ground"),
    (lambda: orbits.secular_j2(orbits.EARTH_GM, -9e3, 1.1, 1.0), "secular rates are those of an ellipse"),
    (lambda: orbits.earth_field(orbits.kepler(1.0, 1.0, 0.1), DAY), "the orbit is below the ground"),
    (lambda: orbits.earth_field(orbits.kepler(orbits.EARTH_GM * 1e9, 7e6, 0.0), DAY), "radius 6371.2 in the orbit's"),
    (lambda: orbits.earth_field(LOW, orbits.julian_date(1950, 1, 1)), "IGRF-14 from 2000 to 2030"),
    (lambda: orbits.earth_field(LOW, "1999-12-31"), "IGRF-14 from 2000 to 2030, got the date 1999-12-31"),
    (lambda: orbits.earth_field(LOW, "March"), "a date must be as in"),
    (lambda: orbits.earth_field(LOW, DAY, degree=14), "degree must be at most 13, the last one of IGRF, got 14"),
    (lambda: orbits.earth_field(LOW, DAY, degree=0), "degree must be an integer ≥ 1"),
    (lambda: orbits.earth_field(LOW, DAY, [0.1, 0.2, 0.9], degree=2), "degree must be at most 1 with the coefficients"),
    (lambda: orbits.julian_date(2024, 2, 30), "must be a day of the calendar"),
    (lambda: orbits.atmosphere(LOW, -1.0, 60.0, 500.0), "density must be positive"),
    (lambda: orbits.eclipse(LOW, [1.0, 0, 0], shadow="sphere"), "shadow must be"),
    (
        lambda: orbits.eclipse(LOW, [2.0, 0, 0], shadow="cylindrical"),
        r"sun must be a unit vector, got \[2\. 0\. 0\.\] of l",
    ),
    (lambda: orbits.lvlh(lambda t: t), "orbit must be a function of the time t"),
    (lambda: orbits.vector_table([0.0, 1.0], np.zeros((2, 3))), "at least 3 entries"),
    (lambda: orbits.kepler(0.0, 1.0, 0.5), "mu must be positive, got 0.0"),
    (lambda: orbits.hyperbola(1.0, 0.0, 0.5), "distance must be positive, got 0.0"),
    (lambda: orbits.hyperbola(1.0, 1.0, 0), "speed must be positive, got 0.0"),
    (lambda: orbits.encounter_speed(0.9, 0.2j, 0.1), "eccentricity must hold real numbers"),
    (lambda: orbits.kepler(1.0, 1.0, 1.0), "eccentricity must not be 1: a parabola has no semi-major axis"),
    (lambda: orbits.kepler(1.0, 1.0, 1.5), "a hyperbola semi_major_axis < 0 and eccentricity > 1, got 1.0 and 1.5"),
    (lambda: orbits.kepler(1.0, -1.0, 0.5), "an ellipse has semi_major_axis > 0"),
    (lambda: orbits.kepler(1.0, 0.0, 0.5), "semi_major_axis must not be 0"),
    (lambda: orbits.kepler(1.0, 1.0, -0.1), "eccentricity must be ≥ 0, got -0.1"),
    (lambda: orbits.kepler(1.0, np.nan, 0.1), "semi_major_axis must be finite"),
    (lambda: orbits.kepler(1.0, [1.0, 2.0], 0.1), "semi_major_axis must have shape"),
    (lambda: traced(0.0, None, 0.5), "mu must be positive"),
    (lambda: traced(1.0, 0.0, None), "semi_major_axis must not be 0"),
    (lambda: traced(1.0, None, 1.0), "eccentricity must not be 1"),
    (lambda: traced(1.0, None, -0.5), "eccentricity must be ≥ 0"),
    *rows(lambda t: orbits.graded_times(FLYBY, 0.0, t, 8), "t0 and t1 must be finite and differ", 0.0, np.nan),
    (lambda: orbits.graded_times(FLYBY, 0.0, 1.0, 0), "n must be an integer ≥ 1"),
    (lambda: epoch("2023-02-29"), "does not exist"),
    (lambda: epoch("2023-366"), "2023 has no day 366"),
    (lambda: epoch("yesterday"), "must be as in"),
    (lambda: epoch("2024-03-01T25:00"), "no time of a day"),
    (lambda: epoch("2024-03-01T24:00:01"), "ends at 24:00:00"),
    (lambda: epoch("2024-03-01 PST"), "one of UTC, UT1"),
    (lambda: epoch(float("nan")), "the number nan alone is no date: name what it counts"),
    (lambda: epoch(None), "give exactly one of date, jd, mjd, unix"),
    *rows(
        orbits.sun_direction, "a Julian date must be from 1721425.5 to 5373484.5", 60370.5, 1709294400.0, float("nan")
    ),
    *rows(lambda t: orbits.earth_field(LOW, t), "a Julian date must be from", 60370.5, np.float32(60370.5), [1.0]),
    (lambda: orbits.sun_direction("x"), "a date must be as in"),
    (lambda: orbits.julian_date(2024, 3, 1, np.nan), "hours must be a finite number, got nan"),
    (lambda: epoch("2024-03-01 TT", "UTC"), "is in TT, and UTC was asked for"),
    (lambda: epoch(datetime.datetime(2024, 3, 1, tzinfo=datetime.UTC), "TT"), "is in UTC, and TT was asked for"),
    (lambda: epoch("9999-366"), "9999 has no day 366"),
    (lambda: epoch("2024-03-01") + float("inf"), "must be finite, got inf"),
    (lambda: epoch("2024-03-01 TT").to("UTC"), "leap seconds"),
    (lambda: orbits.graded_times(FLYBY, 0.0, 1.0, 8, c=0.0), "c must be positive and finite"),
]

LUMPS = [[[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0.1, 0, 0]]]
WEIGHTS = [[1.0, 1.0, 1.0], [1.0]]
MASSES = potentials.point_masses(2.0, WEIGHTS, LUMPS)
FIELD = potentials.uniform_field([0.3, -0.2, -1.0], [1.0, 2.0, 1.0])
SOLID = potentials.polyhedron(2.0, (CUBE, FACES), 1.5)
BOX_SHAPE, NEEDLE = shapes.box([1, 2, 1], mass=1.0), shapes.ellipsoid([2.0, 1.0, 1.0], mass=1.0)
PAIR = np.zeros((1, 2, 3))


def closed_in():
    """A body within the sphere around an ellipsoid."""
    bodies = rigid_bodies([1.0, 0.1], [[1.0, 1, 1]] * 2, potentials.mutual_gravity(1.0, [NEEDLE, 0.1]))
    bodies.state([[0, 0, 0], [0.0, 1.9, 0]])


def two_cubes(offset, inward=False):
    """A cube with edges of 5, and one of 1 whose faces may be turned inward."""
    second = np.array([face[::-1] for face in FACES] if inward else FACES) + 8
    shapes.mesh(np.concatenate([5 * CUBE, np.add(CUBE, offset)]), [*FACES, *second], density=1.0)


POTENTIALS = [
    (lambda: potentials.point_masses(1.0, [1.0, -1.0]), "masses must be ≥ 0"),
    (lambda: potentials.point_masses(1.0, 1.0), "masses must have an entry for each body"),
    (lambda: potentials.point_masses(1.0, [1.0, 1.0], softening=-1.0), "softening must be a length ≥ 0"),
    (lambda: potentials.point_masses(1.0, WEIGHTS, LUMPS[:1]), "masses and points must have the same number"),
    (lambda: potentials.lennard_jones([1.0, 1.0], [0.0, 1.0]), "sizes must be > 0"),
    (lambda: potentials.sites(np.zeros((2, 3)), [1.0], [1.0], [1.0]), r"points must have shape \(N, n, 3\)"),
    (lambda: potentials.sites(np.zeros((2, 1, 3)), [0.0], [0.0], [1.0]), "there is no force"),
    (lambda: potentials.springs([[0, 0]], PAIR, 1.0), "a spring must join two bodies"),
    (lambda: potentials.springs([[0, 1]], PAIR, -1.0), "stiffness must not be negative, got -1"),
    (lambda: potentials.springs([0, 1], PAIR, 1.0), "bodies must be pairs"),
    (
        lambda: potentials.springs([[0, 3]], PAIR, 1.0)(EYE, np.stack([EYE] * 3)),
        "springs join the bodies .* there are 3",
    ),
    (lambda: potentials.uniform_field([0.0, 0, 0], [1.0]), "field must not be 0"),
    (lambda: potentials.outer_field(1.0, [1.0]), "phi must be a function"),
    (lambda: potentials.outer_field(jnp.sum, [1.0], conserved=[1.0]), "conserved must be rows"),
    (lambda: potentials.ellipsoid_sphere(1.0, [1.0, 1.0], [1.0, 0.0, 1.0]), "semi_axes must be positive"),
    (lambda: potentials.water("SPC"), "model must be one of 'TIP4P', 'TIP4P/2005', got 'SPC'"),
    (lambda: (potentials.maccullagh(1.0, [1.0], [[1.0, 1, 1]]) + FIELD).count, "the same number of bodies"),
    (lambda: rigid_bodies([1.0] * 3, np.ones((3, 3)), MASSES), "potential is for 2 bodies, but there are 3 masses"),
    (lambda: potentials.molecule([1.0, 1.0], [[0, 0, 0], E3]), "must not lie on one line"),
    (lambda: potentials.molecule([1.0, -1.0], [[0, 0, 0], E3]), "masses must be finite and ≥ 0"),
    (lambda: potentials.molecule([1.0], [[0, 0]]), r"points \(n, 3\) are needed"),
    (lambda: potentials.molecule(J, EYE, J, J), "sizes must be positive where wells are"),
    (lambda: potentials.polyhedron(1.0, BOX_SHAPE), "this one has none"),
    (lambda: potentials.polyhedron(1.0, (CUBE, FACES)), "density must be given"),
    (lambda: potentials.polyhedron(1.0, (CUBE, FACES[1:]), 1.0), "surface must be closed"),
    (lambda: SOLID.value([1.0, 2.0]), r"x must be points \(…, 3\)"),
    (lambda: rigid_bodies([1.4, 1.0], EYE[:2] + 1, SOLID), "density times volume, 1.5, got 1.4"),
    (lambda: rigid_bodies([1.5], EYE[:1] + 1, SOLID), "two bodies or more"),
    (lambda: potentials.mutual_gravity(1.0, [1.0, 2.0], 5), "order must be 2, 3 or 4, got 5"),
    (lambda: potentials.mutual_gravity(1.0, [1.0], 2), "two or more shapes or masses"),
    (lambda: potentials.mutual_gravity(1.0, [1.0, -2.0], 2), r"mass of shapes\[1\] must be positive"),
    (lambda: potentials.mutual_gravity(1.0, [1.0, "stone"], 2), r"shapes\[1\], if it is not a shape"),
    (closed_in, r"inside the enclosing sphere of another.*potentials\.polyhedron"),
    *rows(lambda r: systems.self_gravity(1.0, 1.0, r), "radius must be (positive|finite)", -1.0, 0.0, np.nan),
]
SHAPES = [
    *rows(
        lambda size: shapes.mesh(size * np.array(CUBE), FACES, mass=1.0),
        r"coordinates must be at most 2\.8e\+60, beyond which moments of inertia overflow, got",
        *(1e103, 1.5e308),
    ),
    (lambda: shapes.mesh(1e-103 * np.array(CUBE), FACES, mass=1.0), "the mesh must enclose a volume, got 0"),
    *rows(lambda size: shapes.box([size] * 3, mass=1.0), "the volume of a shape must be from", 1e103, 1e-103),
    (lambda: shapes.mesh(CUBE, FACES[:-1], mass=1.0), "the surface must be closed, but 3 edges"),
    (lambda: shapes.mesh(CUBE, [FACES[0][::-1], *FACES[1:]], mass=1.0), "all faces must be oriented alike"),
    (lambda: shapes.mesh(CUBE * [1, 1, 0], FACES, mass=1.0), "must enclose a volume"),
    (lambda: shapes.mesh(CUBE, [[0, 1, 9]], mass=1.0), "faces must be indices from 0 to 7"),
    (lambda: shapes.mesh(CUBE, [[0, 1, 1]], mass=1.0), "three distinct vertices"),
    (lambda: shapes.mesh(CUBE, FACES), "give exactly one of mass, density"),
    (
        lambda: two_cubes([7, 0, 0], True),
        r"face 12 \(12 faces around \[7\.5 .*volume -1\) is oriented unlike .* face 0",
    ),
    (
        lambda: two_cubes([2, 2, 2]),
        r"face 12 \(12 .* \[2\.5 .*volume 1\) lies inside another part and is oriented like",
    ),
    (lambda: two_cubes([4.5, 0, 0], True), "is oriented unlike the part with face 0 and lies in no other part"),
    (lambda: shapes.box([1, 2, -1], mass=1.0), "edges must be positive"),
    (lambda: shapes.sites([1.0, -1.0], [[0, 0, 0], [1, 0, 0]]), "total mass must be positive"),
    (lambda: BOX_SHAPE.moments(5), "order must be 0, 1, 2, 3 or 4, got 5"),
    (lambda: shapes.box([1, 2, 1], mass=0.0), "mass must not be 0"),
    (lambda: shapes.body(mass=0.0, inertia=[1, 1, 1]), "mass must be positive"),
    (lambda: shapes.body(mass=1.0, inertia=[1, 1, 0]), "inertia must be positive definite"),
    (lambda: shapes.body(mass=1.0, inertia=EYE, center=[0, np.nan, 0]), "center must be finite"),
]

M, JS, V = [1.0, 0.1], np.ones((2, 3)), potentials.maccullagh(1.0, [1.0, 0.1], np.ones((2, 3)))
X = np.array([[0.0, 0, 0], [3.0, 0, 0]])
BODIES = rigid_bodies(M, JS, V)
THREE = rigid_bodies([1.0] * 3, np.ones((3, 3)), potentials.point_masses(1.0, [1.0] * 3))


def dissipation(law):
    return rigid_bodies(M, JS, potentials.point_masses(1.0, M), law)


def gains(r, v, omega_i, omega_j):
    return 0.1 * v, -0.1 * jnp.cross(r, v), jnp.zeros(3)


def pushed(forces):
    return rigid_bodies(M, JS, potentials.point_masses(1.0, M), forces=forces)


REST = pushed(lambda t, x, R, v, w: (0 * x, 0 * x))
ROUND = systems.circular_section(0.1, 2e3, 5.0, poisson=0.25)


def chain(lengths=(1.0, 1.0), stretching=(50.0, 40.0, 90.0), bending=(1.0, 1.3, 0.8), **options):
    potentials.rod(lengths, stretching, bending, **options)


def rod(elements=3, section=ROUND, **options):
    systems.rod(1.0, elements, section, **options)


RODS = [
    (lambda: chain(1.0), r"lengths must have shape \(N - 1,\)"),
    (lambda: chain([1.0, 0.0]), "lengths must be positive"),
    (lambda: chain(stretching=(1.0, -1, 1)), "stretching must not be negative"),
    (lambda: chain(bending=(1.0, 1)), r"bending must have shape \(3,\) or \(2, 3\)"),
    (lambda: chain(energy="cubic"), "energy must be one of fourth, directors"),
    (lambda: rod(0), "elements must be an integer"),
    (lambda: rod(ends="clamped"), "ends must be a pair"),
    (lambda: rod(ends=("free", "pinned")), r"ends\[1\] must be \"free\""),
    (lambda: rod(ends=([0, 0, 0, 1, 1, 0, 0], "free")), r"ends\[0\] must be a unit quaternion"),
    (lambda: rod(ends=(lambda t: 2 * jnp.eye(7)[3], "free")), r"ends\[0\] at t = 0 must be a unit quaternion"),
    (lambda: rod(ends=(lambda t: jnp.zeros(6), "free")), r"ends\[0\] must be a function of the time"),
    (lambda: rod(section="steel"), "section must be circular_section"),
    (lambda: rod(1, ends=("clamped", "clamped")), "section that moves"),
    (
        lambda: rod(ends=("clamped", "free"), loads={0: lambda t: jnp.zeros(6)}),
        "loads act on sections that move, 1 to 3",
    ),
    (lambda: rod(loads={-1: lambda t: jnp.zeros(3)}), r"loads\[-1\] must be a function of the time"),
    (lambda: rod(damping=-0.1), "damping must not be negative"),
    (lambda: rod(section=ROUND._replace(mass=[1.0, 2.0])), r"section.mass must have shape \(\) or \(3,\)"),
    (lambda: systems.circular_section(0.1, 1.0, 1.0, poisson=0.6), "poisson must be"),
]
MANY_BODIES = [
    (lambda: rigid_bodies([1.0, -0.1], JS, V), "masses must be positive"),
    (lambda: rigid_bodies(1.0, JS, V), r"masses must have shape \(N,\)"),
    (
        lambda: rigid_bodies(M, EYE, V),
        r"inertias must have shape \(2, 3\) or \(2, 3, 3\), as many as masses; got \(3, 3\)",
    ),
    (lambda: rigid_bodies(M, -JS, V), "positive"),
    (lambda: rigid_bodies(M, JS, 1.0), "potential must be a function"),
    (lambda: BODIES.state(X[:1]), r"positions must have shape \(2, 3\)"),
    (lambda: BODIES.state(0 * X), "bodies 0 and 1 are at the same position"),
    (lambda: BODIES.state(X, attitudes=np.ones((2, 4))), r"attitudes\[0\] must be a unit quaternion"),
    (lambda: BODIES.state(X, attitudes=np.ones((2, 5))), "attitudes must have shape"),
    (lambda: BODIES.state(X, velocities=X * np.nan), "velocities must be finite"),
    (lambda: rigid_bodies(M, JS, lambda x, R: x[0]), r"got shape \(3,\) and dtype float64"),
    (lambda: rigid_bodies(M, JS, lambda x, R: None), "a real scalar as its value, got None"),
    (lambda: rigid_bodies(M, JS, lambda x, R: 0), "got shape .* and dtype int64"),
    (lambda: rigid_bodies(M, JS, lambda x, R: 1j * x[0, 0]), "got shape .* and dtype complex128"),
    (lambda: rigid_bodies(M, JS, lambda x, R: np.sum(np.asarray(x))), "which JAX can trace, .* fails: .*traced array"),
    (lambda: rigid_bodies(M, JS, lambda x: x[0, 0]), "it fails: .*takes 1 positional argument but 2 were given"),
    (lambda: rigid_bodies(M, JS, lambda x, R: {}[0]), "it fails: KeyError: 0"),
    (lambda: rigid_bodies(M, JS, lambda x, R: jnp.log(-x[1, 0])).state(X), "potential must be finite at the start"),
    (lambda: dissipation(3.0), "law of pairs"),
    (lambda: dissipation(tides.constant_lag(1.0, [1.0] * 3, [1.0] * 3, 0.1, 0.1)), "3 bodies.*2 mass"),
    (lambda: dissipation(lambda r, v, a, b: (v[:2], v, v)), "dissipation must be a function"),
    (lambda: dissipation(lambda r, v, a, b: (-v, 0 * v, 0 * v)), "angular momentum"),
    (lambda: dissipation(lambda r, v, a, b: (0 * v, a - b, b - a)), "must not add energy"),
    (lambda: dissipation(gains), r"must not add energy.*Check its sign, or give forces .* as forces="),
    (lambda: tides.constant_lag(1.0, M, M, M, -1.0), "lags must be ≥ 0"),
    (lambda: tides.constant_lag(1.0, M, [0.0, 1.0], M, 1.0), "radii must be positive"),
    (lambda: tides.constant_q(1.0, M, M, M, Q=[5.0, 0.0], threshold=1.0), "Q must be positive"),
    (lambda: tides.constant_q(1.0, M, M, M, Q=5.0, threshold=0.0), "threshold must be positive"),
    (lambda: tides.constant_lag(1.0, [1.0], [1.0], 0.1, 1.0), "N ≥ 2"),
    (
        lambda: pushed(lambda t, x, R, v, w: x),
        r"the forces that forces returns must be .* of shape \(2, 3\) .*got shape \(3,\)",
    ),
    (lambda: pushed(lambda t, x, R, v, w: (x, x[0])), r"the torques that forces returns must be .* got shape \(3,\)"),
    (lambda: pushed(lambda t, x, R, v, w: (x, x, x)), "too many values"),
    (lambda: pushed(lambda t: t), "takes 1 positional argument"),
    (lambda: pushed(3), "the forces that forces returns must be a function"),
    (lambda: REST.check(REST.state(X)._replace(t=None, work=None)), "its state needs the time"),
    (lambda: REST.check(REST.state(X)._replace(work=np.zeros(2))), r"state\.work must have shape \(\)"),
]

MATERIAL = systems.neo_hookean(20.0, 6.0)
ELASTIC, VISCOUS = (systems.pseudo_rigid_body([2.0, 1.5, 1.0], MATERIAL, *more) for more in ((), (0.5,)))
BALL, EMBEDDED = systems.incompressible_body(np.full(3, 0.2), MATERIAL), systems.embedded_body([1.0, 2.0, 3.0])
BOB = systems.pendulum(1.5, 1.0, [0.48, 0.6, 0.64])
SE2 = groups.special_euclidean(2)
GYROSTAT, SPIN_UP = gyrostat(J, E3), systems.driven_gyrostat(J, lambda t: jnp.stack([t, t, t]))
CONING = systems.kinematics(groups.so3, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0 * t]))
ORBIT = orbits.kepler(1.0, 1.0, 0.1)
SATELLITE = systems.gravity_gradient(J, ORBIT)
MOVING = SATELLITE.state(angular_velocity=SPIN, work=0.0)
PERIODS, APOPHIS = {"precession": 1.0, "rotation": 20.0}, systems.rigid_body([0.61, 0.965, 1.0])
SYSTEMS = [
    *rows(systems.rigid_body, "positive definite", [1.0, 2, -3], [[1.0, 2, 0], [2, 1, 0], [0, 0, 1]], [0.0, 1.0, 1.0]),
    (lambda: systems.rigid_body([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
    *rows(systems.rigid_body, "finite", [1.0, np.nan, 1.0], [1.0, np.inf, 1.0]),
    *rows(systems.rigid_body, r"shape \(3,\) or \(3, 3\)", [1.0, 2.0], 3.0, np.ones((2, 3))),
    *rows(systems.rigid_body, "real numbers", ["one", "two", "three"], [1j, 1, 1], None, [[1, 2], [3]]),
    *rows(lambda q: BODY.state(q, angular_velocity=SPIN), "unit quaternion", [1.0, 0, 0, 2e-2], 0 * ONE, 1.0002 * ONE),
    *rows(lambda q: BODY.state(q, angular_velocity=SPIN), "orthogonal", EYE * 1.001, np.ones((3, 3))),
    (lambda: BODY.state(np.diag([1.0, 1, -1]), angular_velocity=SPIN), "reflection"),
    *rows(lambda q: BODY.state(q, angular_velocity=SPIN), "finite", np.nan * ONE, np.full((3, 3), np.inf)),
    *rows(
        lambda q: BODY.state(q, angular_velocity=SPIN),
        r"quaternion \(w, x, y, z\), shape \(4,\), or a rotation matrix \(3, 3\)",
        [1.0, 0, 0],
        np.eye(4),
    ),
    (lambda: BODY.state([0.1, 0.2, 0.3], angular_velocity=SPIN), r"Euler angles: li\.attitude\.from_euler"),
    (lambda: BODY.state(Rotation.identity(2), angular_velocity=SPIN), r"one scipy Rotation, got shape \(2, 4\)"),
    (lambda: BODY.state(ONE, angular_velocity=10**400), "real numbers"),
    (lambda: BODY.state(ONE, angular_velocity=[1e308, 1e308, 1e308]), "spatial momentum must be finite"),
    (lambda: BODY.state(ONE), "exactly one of angular_velocity"),
    (lambda: BODY.state(ONE, angular_velocity=SPIN, body_momentum=SPIN), "exactly one of angular_velocity"),
    (lambda: BODY.state(ONE, angular_velocity=JS), r"angular_velocity must have shape \(3,\).*jax.vmap"),
    (lambda: EMBEDDED.check(li.State(-jnp.eye(3), jnp.ones(3))), "positive determinant"),
    (lambda: potential_top(J, jnp.sum, [0.0, 0.0, 0.0]), "axis must not be zero"),
    (lambda: potential_top(J, 3.0), "potential must be a function of Γ"),
    (lambda: potential_top(J, lambda G: G), r"function of Γ.* with a real scalar as its value, got shape \(3,\)"),
    (
        lambda: potential_top(J, lambda R: R[0] @ jnp.ones(4), None),
        "function of the rotation matrix .* it fails: .*dot_general requires",
    ),
    (lambda: systems.heavy_top(J, [1.0, 2.0]), "weight"),
    (lambda: gyrostat(J, [0.0, 1.0]), r"rotor must have shape \(3,\), got \(2,\)"),
    (lambda: gyrostat(J, [0.0, np.nan, 1.0]), "rotor must be finite"),
    (lambda: GYROSTAT.state(ONE), "exactly one of angular_velocity, body_momentum, spatial_momentum"),
    *rows(lambda x: systems.driven_gyrostat(J, x), r"function of the time t with values \(3,\)", "on", np.zeros(3)),
    (
        lambda: systems.driven_gyrostat(J, lambda t: jnp.stack([t, t])),
        r"of shape \(3,\) as its value, got shape \(2,\)",
    ),
    (
        lambda: systems.driven_gyrostat(J, lambda: jnp.zeros(3)),
        r"motor must be a function of the time t.* it fails: .*positional argument",
    ),
    (lambda: SPIN_UP.state(ONE, angular_velocity=SPIN, work=[0.0]), r"work must have shape \(\)"),
    (lambda: SPIN_UP.state(ONE, angular_velocity=SPIN, rotor=[0, np.inf, 0]), "rotor must be finite"),
    (lambda: systems.inertia_in_time(J), r"inertia must be a function of the time t.*systems.rigid_body"),
    (
        lambda: systems.inertia_in_time(lambda t: jnp.ones(2) * t),
        r"with an array of real numbers of shape \(3,\) as its value, got shape \(2,\)",
    ),
    (
        lambda: systems.inertia_in_time(lambda t: [float(t)] * 3),
        "inertia must be a function of the time t, which JAX can trace",
    ),
    (lambda: torqued_body(lambda t: jnp.ones(3), spin), r"a function of time: systems\.inertia_in_time"),
    (lambda: SATELLITE.energy(li.State(MOVING.q, MOVING.p)), "needs the time: make it with system.state"),
    (lambda: SATELLITE.state(angular_velocity=SPIN, t=[0.0, 1]), "t must have shape ()"),
    (lambda: SATELLITE.state(angular_velocity=SPIN, work="much"), "work must be an array of real numbers"),
    (lambda: systems.gravity_gradient(J, ORBIT, mu=-1.0), "mu must be positive, got -1"),
    (lambda: systems.gravity_gradient(J, lambda t: (t, t)), "the orbit has no attribute mu: give mu"),
    (lambda: systems.gravity_gradient(J, lambda t: (t, t), 1.0), r"each of shape \(3,\), got shapes"),
    (lambda: systems.gravity_gradient(J, 7.0), "orbit must be a function"),
    (lambda: systems.driven_top(J, lambda Gamma: Gamma[0]), r"function of \(Γ, t\).*it fails"),
    (lambda: systems.driven_top(J, lambda Gamma, t: Gamma), "a real scalar as its value, got shape"),
    (
        lambda: systems.driven_top(J, lambda Gamma, t: t, lambda t: t),
        r"axis .* shape \(3,\) as its value, got shape \(\)",
    ),
    (lambda: systems.driven_top(J, lambda Gamma, t: t, [0, 0, 0]), "axis must not be zero"),
    (lambda: systems.driven_top(J, 3.0), "potential must be a function of"),
    *rows(lambda top: top.Gamma(MOVING), "has no axis γ", FIELD_TOP, WELLS),
    *rows(
        lambda top: systems.lagrange_motion(top, MOVING),
        "J₁ = J₂ and the weight along the third axis",
        systems.heavy_top([1.0, 1.01, 0.5], E3),
        systems.heavy_top([1.0, 1.0, 0.5], [1e-3, 0.0, 1.0]),
        systems.heavy_top([[1.0, 0.0, 0.01], [0.0, 1.0, 0.0], [0.01, 0.0, 0.5]], E3),
        FIELD_TOP,
    ),
    (lambda: systems.pendulum(-1.0, 1.0), "mass must be positive"),
    (lambda: systems.pendulum(1.0, 1.0, [0, 0, 2]), "axis must be a unit vector"),
    (lambda: systems.pendulum([1.0], 1.0), "mass must have shape"),
    (lambda: systems.pendulum(1.0, lambda s: None), "gravity must be a function of γ·q with a real scalar"),
    (lambda: BOB.state([1.0, 0], velocity=[0, 0, 1]), "direction must have shape"),
    (lambda: BOB.state([1.0, 0, 0], velocity=[0, 0, jnp.nan]), "velocity must be finite"),
    (lambda: BOB.state([1.0, 1, 0], velocity=[0, 0, 1]), "direction must be a unit vector"),
    (lambda: BOB.state([1.0, 0, 0], velocity=[1, 0, 1]), "orthogonal to q"),
    (lambda: BOB.state([1.0, 0, 0]), "exactly one of velocity, momentum; got none"),
    (lambda: BOB.check(li.State(jnp.array([1.0, 0, 0]), jnp.array([1.0, 0, 0]))), "made|make it"),
    (lambda: systems.pseudo_rigid_body([1.0, -1, 1], MATERIAL), "positive definite"),
    (lambda: systems.pseudo_rigid_body([1.0, 1], MATERIAL), "inertia must have shape"),
    (lambda: systems.pseudo_rigid_body(np.ones((3, 3)), MATERIAL), "positive definite"),
    (lambda: systems.pseudo_rigid_body([[1, 0, 0], [0, 1, -1], [0, 1, 1]], MATERIAL), "symmetric"),
    (lambda: systems.pseudo_rigid_body([1.0, 1, 1], 3.0), "a callable W"),
    (lambda: systems.pseudo_rigid_body([1.0, 1, 1], lambda C: C), "with a real scalar as its value"),
    (lambda: systems.pseudo_rigid_body(np.full(3, 2.0), MATERIAL, -1.0), "viscosity must be ≥ 0"),
    (lambda: systems.mooney_rivlin(-1.0, 1.0), "lam must be positive"),
    (lambda: systems.neo_hookean(1.0, 0.0), "mu must be positive"),
    *rows(lambda F: ELASTIC.state(F, momentum=EYE), "det deformation", -EYE, 0 * EYE),
    (lambda: ELASTIC.state(np.eye(2), momentum=EYE), "deformation must have"),
    (lambda: ELASTIC.state(EYE), "exactly one of"),
    (lambda: ELASTIC.state(EYE, momentum=[1.0]), "shape"),
    (lambda: ELASTIC.check(li.State(-jnp.eye(3), jnp.eye(3))), "det state.q"),
    (lambda: BALL.state(2 * EYE, angular_velocity=E3), "det deformation must be 1 to 1e-06, got 8; divide"),
    (lambda: systems.group_potential(SE2, [1.0, 1, 1], 3.0), "function of q"),
    (lambda: systems.group_potential(SE2, [1.0, 1, 1], lambda q: q), "scalar"),
    (lambda: systems.group_potential(SE2, [1.0, 1, 1], jnp.sum, [1.0, 2.0]), "symmetry must have shape"),
    (lambda: systems.euler(groups.so3, J, "both"), "invariance must be 'left' or 'right', got 'both'"),
    (lambda: systems.euler(groups.so3, J, "right").state(), "exactly one of velocity, body_momentum, spatial_momentum"),
    (lambda: systems.kinematics(groups.so3, np.ones(3)), "rate must be a function of t"),
    (lambda: systems.kinematics(groups.so3, lambda t: t), r"rate must be a function of t, .*shape \(3,\)"),
    (lambda: systems.kinematics(groups.so3, CONING.rate, "world"), "frame must be 'body' or 'space'"),
    (lambda: systems.sampled_rate([0, 1], JS, "means"), "kind must be 'interpolate' or 'mean'"),
    (lambda: systems.sampled_rate([0, 1, 2], JS, "mean"), r"\(n, d\) for n \+ 1 times, n ≥ 3"),
    (lambda: systems.sampled_rate([0, 1, 2], JS), r"\(n, d\) for n times, got \(2, 3\) for 3"),
    (lambda: systems.sampled_rate([0, 2, 1], EYE), r"times must increase, got 2\.0 before 1\.0"),
    (
        lambda: CONING.state(np.ones(4)),
        r"q must be a unit quaternion \(w, x, y, z\), the scalar part first: its norm is 2, allowed is 1",
    ),
    (lambda: CONING.state(t=None), "t must be a number"),
]

SKEWED = schemes.so3_alpha(EMBEDDED, 0.3)
DENSE, THERMOSTAT = schemes.exact(OTHER), schemes.langevin(TOP, 1.0, [0.5, 0.7, 1.0])
LEFT = systems.euler(groups.so3, J)
SL3 = systems.euler(groups.special_linear(3), np.ones(8))


def checked(step, dt, **replaced):
    """A step whose starting state has other parts."""
    step.check(MOVING._replace(**replaced), dt)


class NotAPytree:
    """What somebody writes at first: a class with a `__call__`."""

    def __call__(self, state, dt):
        return state, li.StepInfo.empty(state.p)


ATTRACTED = systems.heavy_top(J, [0.0, 0.0, -1.0])
LOGARITHMIC = schemes.log_hamiltonian(ATTRACTED)
ENERGY = float(ATTRACTED.energy(ATTRACTED.state(angular_velocity=SPIN)))
NO_STEPS = NotAPytree(), lambda state, dt: (state, None), "so3_midpoint", BODY
NO_STEP = r"step must be a Step.*li\.Step.*li\.pytree"
NO_DT = np.array([0.1, 0.2, 0.3]), 0.1j, "fast", None, [0.1]
NARROW = jnp.bfloat16, jnp.float16


def narrowed(dtype):
    return jax.tree.map(lambda x: x.astype(dtype), STATE)


SCHEMES = [
    *rows(lambda x: integrate(0.1, 10, step=x), NO_STEP, *NO_STEPS),
    *rows(lambda x: li.run(x, MANY, 0.1, 10, save_every=None), NO_STEP, *NO_STEPS),
    *rows(lambda x: integrate(0.1, 10, step=x, adjoint=REVERSIBLE), NO_STEP, *NO_STEPS),
    *rows(lambda x: li.diagnostics.certify(x, STATE, 0.1, 10), NO_STEP, *NO_STEPS),
    *rows(lambda dt: STEP(STATE, dt), "dt must be a", *NO_DT),
    *rows(lambda dt: STEP.check(STATE, dt), "dt must be a", *NO_DT),
    *rows(lambda dt: integrate(dt, 2), "dt must be a", *NO_DT),
    *rows(lambda x: systems.rigid_body(jnp.array([1, 2, 3], x)), "inertia must be float32 or float64", *NARROW),
    *rows(lambda x: DENSE(narrowed(x), 0.1), r"state\.q must be float32 or float64", *NARROW),
    *rows(lambda x: integrate(0.1, 3, step=DENSE, state=narrowed(x)), r"state\.q must be float32 or fl", *NARROW),
    *rows(
        lambda kappa: schemes.so3_midpoint(BODY, kappa),
        r"κ\(0\) must be the number 1",
        *(lambda x: 2.0 + x, lambda x: jnp.stack([x, x])),
    ),
    *rows(
        lambda body: splitting(TOP, schemes.exact(body)),
        r"splitting with exact: the drift must be a step of system.free",
        *(systems.rigid_body([1.0, 2.0, 2.699]), systems.rigid_body(np.diag(J))),
    ),
    (lambda: schemes.log_hamiltonian(ATTRACTED, ENERGY + 0.01).start(STILL), "needs states of its energy, with −V > 0"),
    (lambda: schemes.log_hamiltonian(TOP).start(STILL), "needs states of its energy, with −V > 0"),
    (lambda: additive(ELASTIC, "magic"), "symplectic, energy, energy_momentum, average"),
    (lambda: additive(ELASTIC, "symplectic", 1.5), r"in \[0, 1\]"),
    (lambda: additive(ELASTIC, "average", 0.3), "alpha = 1/2 only"),
    (lambda: additive(ELASTIC, "average", 0.5, 0), "iterations must be an integer"),
    (lambda: additive(ELASTIC, "average")(ELASTIC.state(EYE, momentum=EYE), "0.1"), "dt must be a real number"),
    (lambda: additive(VISCOUS, "symplectic"), "the rule 'average'"),
    (
        lambda: li.integrate(additive(VISCOUS), VISCOUS.state(EYE, momentum=EYE)._replace(work=JS), 0.1, 1),
        r"state\.work must have shape \(\)",
    ),
    (lambda: additive(BALL), "incompressible_body with the rule 'incompressible'.* got .* with 'average'"),
    (lambda: additive(ELASTIC, "incompressible"), "got PseudoRigidBody with 'incompressible'"),
    (lambda: additive(BALL, "incompressible", 0.3), "alpha = 1/2 only"),
    (lambda: splitting(ELASTIC, additive(ELASTIC)), "the drift of an elastic body is a straight line"),
    (
        lambda: li.diagnostics.modified_energy(splitting(ELASTIC), ELASTIC.state(momentum=0 * EYE), 0.01),
        "modified energy .* except of elastic bodies",
    ),
    *rows(lambda x: schemes.so3_alpha(EMBEDDED, x), "alpha must", -0.1, 1.5, np.nan, [0.5, 0.5], "half"),
    (lambda: li.integrate(SKEWED, BODY.state(angular_velocity=SPIN), 0.1, 1), r"shape \(3, 3\)"),
    (lambda: schemes.group_alpha(LEFT, 1.2), r"alpha must be in \[0, 1\], got 1.2"),
    (lambda: schemes.so3_midpoint(BODY, 1.0), "callable"),
    *rows(lambda k: schemes.so3_midpoint(BODY, iterations=k), "iterations must be an integer ≥ 1", 0, -1, 2.5),
    *rows(lambda k: schemes.preprocessed(BODY, 4, k), "iterations must be an integer ≥ 1", 0, -1, 2.5),
    *rows(lambda k: schemes.calibrated(BODY, k), "iterations must be an integer ≥ 1", 0, -1, 2.5),
    (lambda: schemes.sphere_midpoint(BOB, iterations=0), "iterations must be an integer"),
    (lambda: schemes.preprocessed(BODY, 12), "order must be 4, 6, 8 or 10, got 12"),
    (lambda: compose(SKEWED, 4), "symmetric step of order 2, got 'so3_alpha"),
    (lambda: compose(compose(schemes.so3_midpoint(BODY), 4), 4), "symmetric step of order 2"),
    (lambda: compose("step", 4), "symmetric step of order 2"),
    (lambda: compose(THERMOSTAT, 4), "symmetric step"),
    (lambda: compose(schemes.so3_midpoint(BODY), 5), "order must be 4, 6, 8 or 10, got 5"),
    (lambda: compose(schemes.so3_midpoint(BODY), 4, "kahan_li_6"), "triple_jump, suzuki, commuting_4"),
    (
        lambda: compose(schemes.so3_midpoint(BODY, maps.kappa_cayley), 4, "commuting_4"),
        "method must be one of triple_jump, suzuki for so3_midpoint",
    ),
    (lambda: splitting(TOP, "drift"), "drift must be a symmetric step"),
    (lambda: splitting(GYROSTAT, "exact"), r"symmetric step of system\.free"),
    *rows(schemes.top_energy_momentum, "without an axis; use splitting", FIELD_TOP, WELLS),
    (lambda: gauss(TOP, 0), "stages"),
    (lambda: gauss(TOP, sweeps=0), "sweeps"),
    (lambda: schemes.extrapolate(TOP, 5), "order must be 4, 6, 8, 10, 12, 14, 16, 18 or 20, got 5"),
    (lambda: schemes.extrapolate(1.0), "extrapolate integrates systems"),
    (lambda: schemes.extrapolate(torqued_body(J, torques.sampled(torques.viscous(0.1), 0.1))), "use torqued_midpoint"),
    (lambda: nystrom(BODIES, 5), "order must be 4 or 6, got 5"),
    (
        lambda: nystrom(TOP, 6, schemes.so3_midpoint(TOP.free)),
        r"be of order 6 or more, such as exact\(system.free\), got so3",
    ),
    (lambda: nystrom(TOP, 6, schemes.exact), "drift must be a symmetric step"),
    (lambda: nystrom(TOP, 6, DENSE), "nystrom with exact"),
    (lambda: schemes.kepler_splitting(BODIES, 6), r"order must be 2, \(8, 4\), \(8, 6, 4\), got 6"),
    (lambda: schemes.kepler_splitting(THREE, 2), "is for two bodies, got 3"),
    (lambda: schemes.kepler_splitting(rigid_bodies(M, JS, lambda x, R: 0.0 * x[0, 0])), "the potential has no G"),
    (
        lambda: schemes.kepler_splitting(BODIES, drift=schemes.so3_midpoint(BODY)),
        r"drift must be exact\(system.free\) or prepro",
    ),
    (
        lambda: schemes.kepler_splitting(BODIES, drift=schemes.exact(rigid_bodies([2.0, 2.0], 2 * JS, V).free)),
        "kepler_splitting with free_flight: the drift must be a step of system.free",
    ),
    (lambda: schemes.langevin(TOP, 0.0, 1.0), "temperature must be positive"),
    (lambda: schemes.langevin(TOP, 1.0, -1.0), "friction must be ≥ 0"),
    (lambda: schemes.langevin(TOP, 1.0, np.ones(6)), "friction must have shape"),
    (lambda: schemes.langevin(systems.rigid_body(np.diag(J)), 1.0, [0.5, 0.7, 1.0]), "principal moments, or one rate"),
    (lambda: THERMOSTAT(TOP.state(angular_velocity=SPIN), 0.1), "needs a key"),
    (lambda: THERMOSTAT.start(TOP.state(angular_velocity=SPIN), key=0.5), "key must be jax.random.key"),
    (lambda: schemes.magnus(CONING, 8), "order must be 2, 4 or 6, got 8"),
    (lambda: schemes.magnus(CONING, 6, commutators=False), "commutators=False is of order 4, got order 6"),
    (lambda: li.run(schemes.magnus(CONING), li.State(jnp.array(ONE), np.zeros(0)), 0.1, 1), "state needs the time"),
    *rows(lambda energy: schemes.log_hamiltonian(TOP, energy), "energy", np.nan, [1.0, 2.0], "low"),
    (lambda: group_midpoint(LEFT, 3), "a map"),
    (lambda: splitting(SATELLITE)(MOVING._replace(t=None, work=None), 0.1), "driven, so its state needs the time"),
    (lambda: splitting(SATELLITE)(MOVING._replace(t=None), 0.1), "a state that counts work needs a time"),
    (lambda: splitting(SATELLITE)(MOVING._replace(extra=3.0), 0.1), "state.extra must be a dict of arrays"),
    (lambda: checked(splitting(SATELLITE), 0.1, t=np.nan), "state.t must be finite"),
    (lambda: checked(splitting(SATELLITE), 0.1, work=np.inf), "state.work must be finite"),
]
STEP, STATE = schemes.so3_midpoint(BODY), BODY.state(angular_velocity=SPIN)
KICKED, STILL = splitting(TOP), TOP.state(angular_velocity=SPIN)
MANY = jax.tree.map(lambda x: np.stack([x] * 3), STATE)
GRADED = [0.0, 0.1, 0.3, 0.6]
REVERSIBLE = li.ReversibleAdjoint()
SAME = (lambda c, x: (c, x), 0.0)  # of a scan


def integrate(*arguments, step=STEP, state=STATE, **options):
    return li.integrate(step, state, *arguments, **options)


def ensemble(states=MANY, num_steps=10, dt=0.1, **options):
    return li.run(STEP, states, dt, num_steps, progress=False, **options)


def graded(states=None, times=GRADED, **options):
    states = MANY._replace(t=jnp.array(0.0)) if states is None else states
    return ensemble(states, None, None, times=times, **options)


def batch(states=MANY, step=STEP, **options):
    return li.run(step, states, 0.05, 20, progress=False, **options)


def copies(tree, count=2):
    return jax.tree.map(lambda x: jnp.stack([x] * count), tree)


def by_member(**options):
    return batch(per="member", reduce="energy", **options)


def event(condition=lambda z: z.p[0], max_steps=10, **options):
    return li.event(KICKED, STILL, 0.05, condition, max_steps=max_steps, **options)


def lyapunov(step=STEP, dt=0.05, num_steps=100, **options):
    return li.diagnostics.lyapunov(step, STATE, dt, num_steps, **options)


def transition(step=KICKED, **options):
    return li.transition(step, STILL, 0.1, 60, **options)


def fit(loss=lambda p: p - 1, guess=np.ones(2), *optimizer, **options):  # noqa: B008
    return li.fit(loss, guess, *optimizer, **options)


def changed(part, factor, member=2):
    """The states of three members, one of which has another attitude or momentum."""
    return MANY._replace(**{part: getattr(MANY, part) * np.where(np.arange(3) == member, factor, 1.0)[:, None]})


def saved_at_traced_times(**options):
    jax.eval_shape(lambda t: integrate(0.1, save_at=t, **options), jnp.ones(2))


RUNS = [
    (lambda: integrate(0.1, 10, save_every=3), "not a multiple of save_every = 3; use 9 or 12 steps"),
    (lambda: integrate(0.1, -1), "num_steps must be an integer ≥ 0, got -1"),
    *rows(lambda n: integrate(0.1, n), "num_steps must be an integer", 10.0, True),
    (lambda: integrate(0.1, 10, save_every=0), "save_every must be an integer ≥ 1, got 0"),
    *rows(lambda state: integrate(0.1, 2, state=state), "state must be a State", (STATE.q, STATE.p), None, STATE.q),
    (lambda: integrate(0.1, 9, state=STATE._replace(q=STATE.q * 1.001)), r"state\.q must be a unit quat.*1\.001"),
    (lambda: integrate(0.1, 9, state=STATE._replace(p=STATE.p[:2])), r"state\.p must have shape \(3,\)"),
    (lambda: integrate(0.1, 9, state=STATE._replace(p=STATE.p * np.nan)), r"state\.p must be finite"),
    (lambda: integrate(0.1, 10, save_at=[-0.1, 0.1]), "save_at must lie in the run, from 0.0 to 1.0"),
    (lambda: integrate(0.1, 10, save_at=[0.1, 1.1]), "save_at must lie in the run"),
    (lambda: integrate(0.1, 10, save_at=[0.1, np.nan]), "save_at must be finite"),
    (lambda: integrate(0.1, 10, save_at=0.1), r"save_at must have shape \(m,\)"),
    (lambda: integrate(0.1, 10, save_at=[0.1], save_every=2), "give save_every or save_at, not both"),
    (lambda: integrate(0.1, 10, times=[0.0, 0.1]), "give dt and num_steps, or times, not both"),
    (lambda: integrate(times=[0.0, 0.1, 0.1]), "must increase, or decrease, from one to the next.*at 1"),
    (lambda: integrate(times=[0.0, 0.2, 0.1]), "must increase, or decrease"),
    (lambda: integrate(times=[0.0, np.inf]), "times must be finite"),
    (lambda: integrate(times=[[0.0]]), r"times must have shape \(N\+1,\)"),
    (lambda: integrate(0.1), "give dt and num_steps, or times"),
    (lambda: integrate(times=GRADED, state=STATE._replace(t=jnp.array(3.0))), "at the time of the state, 3.0, got 0.0"),
    (
        lambda: integrate(0.05, 12, save_at=[0.7, 0.1], adjoint=REVERSIBLE),
        "save_at must lie in the run, from 0.0 to 0.6",
    ),
    (lambda: integrate(times=GRADED, adjoint=REVERSIBLE), "steps of one size.*RecursiveCheckpointAdjoint"),
    (lambda: integrate(0.05, 12, adjoint="reversible"), "adjoint must be None.*got 'reversible'"),
    (
        lambda: integrate(0.1, 9, step=SKEWED, state=EMBEDDED.state(angular_velocity=SPIN), adjoint=REVERSIBLE),
        "is not symmetric.*RecursiveCheckpointAdjoint",
    ),
    (lambda: integrate(0.05, 5, save_every=2, adjoint=REVERSIBLE), "multiple of save_every"),
    (lambda: integrate(0.05, save_at=1.0, adjoint=REVERSIBLE), "shape"),
    (saved_at_traced_times, r"number of steps is not known: give num_steps.*or adjoint=li\.ReversibleAdjoint\(\)"),
    (lambda: saved_at_traced_times(adjoint=li.RecursiveCheckpointAdjoint()), "give num_steps"),
    (
        lambda: li.diagnostics.round_trip_error(SKEWED, EMBEDDED.state(angular_velocity=SPIN), 0.1, 4),
        "is not symmetric.*use a symmetric scheme",
    ),
    *rows(ensemble, "leading member axis", MANY._replace(q=MANY.q[:2])),
    (lambda: ensemble(changed("q", np.nan, 1)), r"states\.q must be finite, and is not finite for 1 member\(s\): 1"),
    (lambda: ensemble(changed("q", 1.01)), r"off the configuration space.*1 member\(s\): 2"),
    (lambda: ensemble(save_every=3), "not a multiple"),
    (lambda: ensemble(save_every=0), "save_every must be an integer ≥ 1"),
    (lambda: ensemble(num_steps="10"), "num_steps must be an integer"),
    (lambda: ensemble(dt="fast"), "dt must be a real number"),
    (lambda: ensemble(times=GRADED), "give dt and num_steps, or times, not both"),
    (lambda: ensemble(num_steps=None), "give dt and num_steps, or times"),
    *rows(lambda x: graded(times=x), "times must begin at the time of the state", [-0.1, 0.0, 0.1], GRADED[::-1]),
    (lambda: graded(save_at=[0.3, 0.1]), "save_at must be in the order of the run"),
    (lambda: graded(save_at=[4.0]), "save_at must lie in the run"),
    (lambda: graded(save_at=[0.3], save_every=5), "pass save_at or save_every, not both"),
    (lambda: graded(save_at=[0.3], reduce="energy"), "pass save_at or reduce, not both"),
    (
        lambda: graded(MANY._replace(t=jnp.arange(3.0))),
        r"times hold for all members: give all members the same states\.t, or none",
    ),
    (lambda: batch(per="member"), 'per="member" is of a quantity'),
    (lambda: batch(per="time", reduce="energy"), 'per must be None or "member"'),
    (lambda: batch(first=lambda step, z: z.p[0] < 0.3, reduce="energy"), 'None or "member", which `first` needs'),
    (lambda: by_member(save_every=5), "give no save_every"),
    (lambda: by_member(first=3), "first must be a function"),
    (lambda: by_member(first=lambda step, z: z.p), "first must return True or False"),
    (lambda: by_member(first=lambda z: True), "first must be a function of two arguments"),
    (lambda: batch(copies(MANY)), r"have q of shape \(4,\) and p of shape \(3,\), those of a batch one leading"),
    (lambda: batch(STATE, copies(STEP, 3), own_step=True), "own_step=True is for a batch"),
    (lambda: batch(copies(STATE), copies(STEP)), "there is one system per member.*: give own_step=True"),
    (lambda: li.run(STEP, STATE, times=GRADED).extend(3), "a run at given times cannot be extended"),
    *rows(
        lambda ask: ask(batch(STATE, reduce="energy")),
        r"the run was reduced and has no states but the last ones: see run\.sum",
        *(lambda run: run.state, lambda run: run.at([0.1]), lambda run: run.to_xarray()),
        lambda run: run.map(lambda step, z: z.p[0]),
    ),
    (lambda: ensemble(reduce=lambda step, z: jnp.sum(z.q > 0)), r"floating-point scalar, got int\d+ of shape \(\)"),
    (lambda: ensemble(reduce=lambda step, z: 2), "got 2;"),
    (lambda: ensemble(reduce=lambda step, z: z.q), r"got float64 of shape \(4,\)"),
    (lambda: ensemble(reduce=lambda step, z: z.q[0] + 0j), r"got complex128 of shape \(\)"),
    (lambda: ensemble(reduce=lambda step, z: z.q[0] > 0), "got bool of shape"),
    (lambda: ensemble(reduce=lambda step, z: None), "got None"),
    (lambda: ensemble(reduce=lambda step, z: (z.q[0], z.q[1])), r"got \("),
    (lambda: ensemble(reduce=lambda z: z.q[0]), r"\(step, state\) ↦ scalar: too many positional arguments"),
    (lambda: ensemble(reduce=lambda step, z, k: z.q[0]), r"\(step, state\) ↦ scalar: missing a required argument: 'k'"),
    (lambda: batch(copies(STATE, 5), own_step=True), r"a step for each of 5 members.*leaves of shapes \(3,\)"),
    *rows(lambda x: batch(copies(STATE), threads=x), "threads must be an integer ≥ 1", 0, 2.5, "2"),
    (lambda: batch(copies(STATE), mesh="members"), "mesh must be a jax.sharding.Mesh of one axis"),
    (lambda: li.run(STEP, STATE, 0.5, 6, epoch="noon", progress=False), "must be as in"),
    (lambda: li.run(STEP, STATE, 0.5, 6, epoch=5.0, progress=False), "the number 5.0 alone is no date"),
    (lambda: li.run(STEP, STATE, 0.5, 6, epoch="2024-03-01 EST", progress=False), "scale of a date"),
    (lambda: event(lambda z: z.p), r"condition must have a real scalar value, got shape \(3,\)"),
    (lambda: event(lambda z: z.p[0] > 0), "condition must have a real scalar value"),
    (lambda: event(lambda z: jnp.sqrt(-1 - z.p[0] ** 2)), "condition must be finite at the start, got nan"),
    (lambda: event(7.0), "condition must be a function of the state"),
    (lambda: event(max_steps=0), "max_steps must be an integer ≥ 1, got 0"),
    (lambda: event(direction=2), "direction must be"),
    (lambda: event(count=0), "count must be an integer ≥ 1"),
    (lambda: transition(parameters="mass"), r"holds no number named 'mass'; it has system\.inertia"),
    (lambda: transition(parameters={"inertia": jnp.ones(3)}), "parameters must be names of numbers of the step"),
    (lambda: transition(lambda p: p), "a function of parameters needs their values"),
    (lambda: transition(save_every=7), "not a multiple of save_every"),
    (
        lambda: li.transition(DAMPED, DAMPED.system.state(angular_velocity=SPIN), 0.1, 5, parameters="inertia"),
        r"'inertia' stands for different numbers: system\.inertia, system\.torque",
    ),
    (lambda: li.scan(*SAME, None), r"one number of steps.*got length=None and xs of shapes \[\]"),
    (lambda: li.scan(*SAME, (np.ones(3), np.ones(4))), r"one number of steps.* xs of shapes \[\(3,\), \(4,\)\]"),
    (lambda: li.scan(*SAME, 1.0), r"one number of steps.* xs of shapes \[\(\)\]"),
    (lambda: li.scan(*SAME, np.ones(3), 4), "one number of steps.*got length=4"),
    (lambda: li.scan(lambda c, x: c, 0.0, np.ones(3)), r"a step must return \(carry, y\), got .*Tracer"),
    (lambda: li.scan(lambda c, x: ((c, c), x), 0.0, np.ones(3)), "a carry of the structure that it was given"),
    (
        lambda: li.scan(lambda c, x: ([c[0] * x], x), [np.ones(2, "f4")], np.ones(3)),
        r"carry\[0\] was float32 .*; a step returned float64",
    ),
    (lambda: li.scan(*SAME, length=10, every=3), "every must divide the number of steps, 10, got 3"),
]
DAMPED = schemes.torqued_midpoint(torqued_body(J, torques.viscous(0.1) + torques.kane_damper(0.2, 0.1)))
BASIS = np.zeros((3, 3, 3))
BASIS[0, 0, 1] = BASIS[1, 1, 0] = BASIS[2, 2, 2] = 1
TRUTH = {"a": jnp.array(2.0), "k": jnp.array(0.7)}
FLOW = systems.euler(SE2, np.ones(3))


@functools.partial(jax.jit, static_argnums=0)
def twisted(group, theta):
    return group.exp(theta + 0.1 * jnp.cross(theta, jnp.roll(theta, 1)) * theta[0])


def decay(p):
    return p["a"] * np.ones(3) - p["k"]


OTHERS = [
    (lambda: lyapunov(num_steps=0), "num_steps must be an integer ≥ 1"),
    (lambda: lyapunov(every=3), "not a multiple"),
    (lambda: lyapunov(exponents=7), "got exponents = 7"),
    (lambda: lyapunov(exponents=0), "exponents must be an integer ≥ 1"),
    (lambda: lyapunov(vectors=jnp.eye(5)), "from 1 to 6 tangent vectors"),
    (lambda: lyapunov(vectors=jnp.ones((6, 2))), "linearly independent"),
    (lambda: lyapunov(exponents=1, vectors=jnp.eye(6)), "not both"),
    (lambda: lyapunov(batches=0), "batches must be an integer ≥ 1"),
    (lambda: lyapunov(LOGARITHMIC), "a step of a fictitious time"),
    (lambda: li.diagnostics.megno(STEP, STATE, 0.05, 100, vector=jnp.ones(5)), "vector must have shape"),
    (lambda: li.diagnostics.poisson_error(STEP, STATE, 0.1, 1, method="magic"), "recursion, product"),
    (lambda: li.diagnostics.poisson_error(STEP, STATE, 0.1, 2.5), "num_steps must be an integer"),
    (lambda: li.diagnostics.modified_energy(KICKED, STILL, 0.1, 8), "order must be 4 or 6, got 8; 4 includes H₂"),
    (
        lambda: li.diagnostics.modified_energy(splitting(TOP, schemes.so3_midpoint(TOP.free)), STILL, 0.1, 6),
        "must be exact to order 6",
    ),
    (lambda: li.diagnostics.modified_energy(STEP, STATE, 0.1, 4), "the modified energy is known for"),
    (lambda: fit(guess={"a": jnp.zeros(2), "b": jnp.zeros(3)}, starts=True), "leading axis of starts"),
    (lambda: fit(decay, TRUTH, bounds={"a": li.fitting.positive}), "prefix of the parameter tree"),
    (lambda: fit(jnp.sum, np.ones(2), "newton"), "optimizer must be"),
    (lambda: fit(decay, TRUTH, "lbfgs"), "must be a scalar"),
    (lambda: fit(decay, TRUTH, bounds="positive"), "a tree of Bound objects"),
    *rows(lambda empty: fit(guess=empty), "params holds no numbers", {}, [], jnp.zeros(0)),
    *rows(lambda empty: fit(guess=empty, starts=True), "params holds no numbers", {}, [], jnp.zeros(0)),
    (lambda: fit(lambda p: p[:0]), "the loss returned no residuals"),
    *rows(lambda x: fit(guess={"a": x}), r"params\['a'\] must hold real numbers, got dtype", 1j, "b", object()),
    (lambda: fit(guess=np.ones((2, 1)) * 1j, starts=True), "got dtype complex128: fit real and imaginary parts"),
    *rows(lambda i: fit(lambda p: (p * i).astype(type(i))), "the residuals must hold real numbers", 1, 1j),
    (lambda: fit(lambda p: 1j * p[0], np.ones(2), "lbfgs"), "the loss must hold real numbers"),
    (
        lambda: fit(lambda p, data: data, jnp.ones((2, 1)), starts=True, data=jnp.ones((2, 0))),
        "the loss returned no residuals",
    ),
    (lambda: li.fitting.interval(2.0, 1.0), "an interval needs low < high, got 2.0 and 1.0"),
    (lambda: li.fitting.interval(np.zeros(2), 1.0), "an interval needs two numbers, .*: give a tree of bounds"),
    *rows(lambda tolerance: fit(tolerance=tolerance), "tolerance must be a finite number of at least 0", -1.0, np.nan),
    (lambda: fit(bounds=li.fitting.interval(-1.0, 0.0), starts=True), "inside their bounds"),
    (lambda: groups.matrix(BASIS), r"bracket of basis\[0\] and basis\[1\] leaves the span"),
    (lambda: groups.matrix(BASIS[[0, 2, 0]] + [0 * EYE, 0 * EYE, BASIS[2]]), r"basis\[2\] is a combination of"),
    (lambda: groups.matrix(BASIS[:2] * [[[1]], [[0]]]), r"basis\[1\] is zero"),
    (lambda: groups.matrix(np.ones((2, 3))), "square matrices"),
    (lambda: groups.matrix(BASIS * np.nan), "finite"),
    (lambda: groups.matrix([[["a"]]]), "basis must hold numbers, got dtype <U1"),
    (lambda: groups.symplectic(3), "must be even"),
    (lambda: groups.product(groups.so3, groups.affine(1)), "two matrix groups"),
    *rows(
        lambda x: groups.so3.from_euler(jnp.zeros(3), x),
        "sequence must be three axes of which neighbors differ",
        *("ZZX", "ZXX", "Zxz", "abc", "zx", 3),
    ),
    (lambda: FLOW.check(li.State(np.eye(2), np.zeros(3))), r"state\.q must have shape \(3, 3\), got \(2, 2\)"),
    (lambda: FLOW.check(li.State(2 * EYE, np.zeros(3))), r"state\.q is off the group by .*group\.exp"),
    (lambda: systems.kirchhoff((1.0, 2.0, -1.0)), "semi_axes must be three positive lengths"),
    (lambda: systems.manakov([1.0, 2.0, 3.0]), "at least four positive numbers, .*for n = 3 see rigid_body"),
    (lambda: li.elliptic.F(jnp.zeros(2), jnp.zeros(3)), "must have shapes that broadcast"),
    (lambda: li.elliptic.K(1j), "m must hold real numbers"),
    (lambda: li.attitude.to_mrp([ONE, [1.0, 0, 0, 0.03]]), r"q\[1\] must be a unit quaternion .*1\.0004"),
    (lambda: li.attitude.from_scalar_last([np.nan, 0, 0, 1]), "q must be finite"),
    (lambda: li.attitude.from_scalar_last([1.0, 0, 0]), r"q must have shape \(…, 4\), got \(3,\)"),
    (lambda: li.attitude.from_mrp([1.0, 2.0]), r"sigma must have shape \(…, 3\)"),
    (lambda: li.attitude.from_matrix([EYE, -EYE]), "got a reflection"),
    (lambda: li.attitude.from_matrix(EYE * 1.01), "must be orthogonal"),
    (lambda: li.attitude.to_matrix(ONE, frame="body"), "frame must be .*got 'body'"),
    (lambda: li.attitude.from_euler("XXZ", [0.1, 0.2, 0.3]), "of which neighbors differ"),
    (lambda: li.attitude.to_euler("zyX", ONE), "of which neighbors differ"),
]
VISCOUS_BODY, RUBBED = torqued_body(J, torques.viscous([0.3, 0.1, 0.2])), damped_body(J, 0.3)
SHRINKING = systems.inertia_in_time(lambda t: jnp.array([1.0, 2.0, 2.5]) - t)
FAST = systems.kinematics(groups.so3, lambda t: 8 * jnp.stack([jnp.cos(3 * t), jnp.sin(3 * t), 0 * t]))
SPUN = dict(angular_velocity=[0.5, 3.0, 0.2])
LONG_WAYS = r"what `times` are apart, 4, and a step of 1/8 of it converges: give about 8 times as many times"


def section(states, dt):
    li.diagnostics.section(STEP, states, dt, lambda z: z.q[0], max_steps=10, count=1)


def residuals():
    return li.diagnostics.conditions(STEP, STATE, 0.1)


def kinked(x, R):
    """It is finite where x is 0, and its gradient is not: the slope of the root of 0."""
    return jnp.sum((x[0] - x[1]) ** 2) + jnp.sqrt(jnp.sum(jnp.abs(x[0])))


def motorized(system=SPIN_UP, **replaced):
    """A run of a driven gyrostat whose starting state has other parts."""
    state = SPIN_UP.state(ONE, angular_velocity=SPIN, work=0.0)._replace(**replaced)
    li.integrate(schemes.so3_midpoint(system), state, 0.1, 2)


def keyed(key):
    """A state of a thermostat with this key of its random numbers."""
    state = THERMOSTAT.start(STILL)
    return state._replace(extra=state.extra | {"key": jnp.array(key)})


def interpolated(times, system=BODY, dt=1.0, entries=4):
    """States between those of a body that spins at 1."""
    path = li.integrate(schemes.exact(BODY), BODY.state(angular_velocity=E3), dt, 3)
    li.interpolate(system, jax.tree.map(lambda x: x[:entries], path), times)


def controlled(**options):
    li.integrate(LOGARITHMIC, LOGARITHMIC.start(STILL), **options)


LONG = [  # the others are steps that are too large, with advice
    (lambda: interpolated([5.0], dt=4.0), r"about t = 5 are too far apart to interpolate.*save more often"),
    (lambda: interpolated([-0.1]), r"times must lie in the trajectory, from 0.0 to 3.0"),
    (lambda: interpolated([3.1]), "times must lie in the trajectory"),
    (lambda: interpolated([np.nan]), "times must be finite"),
    (lambda: interpolated(1.0), r"times must have shape \(m,\)"),
    (lambda: interpolated([0.0], entries=1), "two entries or more"),
    (lambda: interpolated([0.0], STEP), "system must be that of the trajectory, got a"),
    (lambda: motorized(t=None, work=None), r"driven, so its state needs the time.*t=0.0"),
    (lambda: motorized(extra=None), r"needs its momentum in state\.extra.*rotor=\(0, 0, 0\)"),
    (lambda: motorized(extra={"rotor": jnp.zeros(2)}), r'extra\["rotor"\] must have shape \(3,\)'),
    (lambda: motorized(extra={"rotor": jnp.full(3, jnp.nan)}), r'extra\["rotor"\] must be finite'),
    (
        lambda: motorized(systems.driven_gyrostat(J, lambda t: jnp.stack([t, t, jnp.log(t - 1)]))),
        r"the motor's torque at t = 0.0 must be finite",
    ),
    (lambda: THERMOSTAT.check(keyed([1.0, 2.0, 3.0, 0.5]), 0.1), "must be a key"),
    (lambda: THERMOSTAT.check(keyed([np.nan] * 4), 0.1), "finite"),
    (lambda: THERMOSTAT.check(keyed([1.0] * 8), 0.1), "shape"),
    (lambda: li.integrate(THERMOSTAT, keyed([0.0] * 8), 0.1, 1), r"key.* must have shape \(4,\), got \(8,\)"),
    (lambda: controlled(times=[0.0, 0.1, 0.2]), r"cannot be given to .*li\.event"),
    (lambda: controlled(dt=0.1, num_steps=2, save_at=[0.1]), r"cannot be given to .*li\.event"),
    (lambda: li.integrate(LOGARITHMIC, LOGARITHMIC.start(STILL), 0.1, save_at=[0.2]), "save_at cannot be given"),
    (lambda: schemes.log_hamiltonian(ATTRACTED, ENERGY)(STILL, 0.1), r"which this state lacks: use step\.start"),
    (lambda: schemes.log_hamiltonian(ATTRACTED)(STILL._replace(t=0.0), 0.1), r"step\.start\(state\)"),
    (
        lambda: splitting(rigid_bodies([1.0, 1.0], 0.1 * JS, kinked)).check(
            rigid_bodies([1.0, 1.0], 0.1 * JS, kinked).state([[0.0, 0, 0], [0.5, 0, 0]]), 0.1
        ),
        r"RigidBodies have no finite value .* derivative of p is not finite",
    ),
    *rows(
        lambda V: schemes.bodies_energy_momentum(rigid_bodies(M, JS, V)),
        "bodies in a potential of relative positions and attitudes",
        lambda x, R: x[0, 2] + jnp.sum((x[1] - x[0]) ** 2),
        potentials.outer_field(lambda r: 0.1 * (r @ r) + 0.02 * r[2], [1.0, 1.0], conserved=np.eye(6)[[5]]),
    ),
    *rows(
        lambda measure: measure(STEP, STATE, 2.0),
        "does not converge",
        *(li.diagnostics.linearization, li.diagnostics.symplectic_defect, li.diagnostics.reversibility),
        lambda *arguments: li.diagnostics.poisson_error(*arguments, 3),
    ),
    (lambda: section(STATE, 0.1), "leading member axis"),
    (lambda: section(MANY, 3.0), "does not converge"),
    (lambda: ensemble(dt=3.0), r"first step fails for 3 member\(s\): 0, 1, 2\. Member 0: .*smaller dt"),
    (
        lambda: li.diagnostics.conditions(schemes.sphere_midpoint(BOB), BOB.phase_space.origin, 0.1),
        "paper for left-in.*got Pen",
    ),
    (lambda: residuals().keeps("group"), "no condition here is one of 'group'"),
    (lambda: li.interpolate(BODY, ensemble(), [1.0]), "the trajectory is of 3 members, and interpolate accepts one"),
    (lambda: integrate(2.0, 10), r"so3_midpoint\[symplectic\] does not converge: \|Δt Ω\| = 2.\d+ at dt = 2"),
    (lambda: integrate(times=[0.0, 4.0, 8.0]), LONG_WAYS),
    (
        lambda: ensemble(num_steps=None, dt=None, times=[0.0, 4.0, 8.0]),
        rf"the first step fails for 3 member.*{LONG_WAYS}",
    ),
    (
        lambda: integrate(times=[0.0, 4.0], state=STATE._replace(q=STATE.q * 1.001)),
        r"1.001, allowed is 1 ± 1e-06[^`]*$",
    ),
    (lambda: DENSE.check(STATE, float("inf")), "exact lost its digits at dt = inf"),
    (
        lambda: integrate(3.0, 1, step=schemes.preprocessed(BODY, 4)),
        r"preprocessed\[4\]: the series .* do not hold at dt = 3.0",
    ),
    (lambda: schemes.group_alpha(LEFT).check(LEFT.state(velocity=SPIN), 30.0), "smaller dt"),
    (lambda: li.integrate(schemes.top_energy_momentum(TOP), STILL, 9.0, 1), "does not converge at dt = 9.0"),
    (lambda: li.integrate(KICKED, STILL, 9.0, 1), "splitting.*so3_midpoint.*does not converge"),
    (
        lambda: schemes.torqued_midpoint(VISCOUS_BODY).check(VISCOUS_BODY.state(**SPUN), 9.0),
        "does not converge at dt = 9.0.* the torque is too stiff.* smaller dt",
    ),
    (
        lambda: schemes.torqued_midpoint(RUBBED).check(RUBBED.state(**SPUN), 2.0),
        "does not converge at dt = 2.0.* the friction is too strong.* smaller dt",
    ),
    (
        lambda: schemes.so3_midpoint(GYROSTAT).check(GYROSTAT.state(angular_velocity=[3.0, 0, 0]), 1.0),
        r"\|Δt Ω\| = 3 at dt = 1.0",
    ),
    (lambda: splitting(gyrostat(J, [6e11, 0, 0])).check(STATE, 1.0), "the rotor turns the body by 6e"),
    (
        lambda: schemes.so3_midpoint(SHRINKING).check(SHRINKING.state(angular_velocity=SPIN, t=0.99), 0.1),
        "not positive definite at t = 1.04, where the function of time returns",
    ),
    (
        lambda: schemes.magnus(FAST).check(FAST.state(), 1.0),
        r"magnus\[4\]: the Magnus series does not converge at dt = 1",
    ),
    (lambda: lyapunov(dt=30.0), "does not converge"),
    (lambda: group_midpoint(LEFT, twisted), r"Ad_τ\(Θ\) Θ = Θ must hold .*maps\.Tau"),
    (lambda: li.integrate(STEP, STATE, -0.05, save_at=np.array([1.0, 0.3])), "side of the start"),
    (lambda: li.integrate(STEP, STATE, 0.0, save_at=np.array([0.3, 1.0])), "dt must not be 0"),
    (
        lambda: APOPHIS.state_from_periods(precession=10.0, rotation=20.0, long_axis=False),
        r"rotation/precession must be above 6\.\d+, that of a small wobble, in the short",
    ),
    (lambda: systems.rigid_body([1, 1, 2]).state_from_periods(**PERIODS, long_axis=True), "has no long-axis mode"),
    (
        lambda: schemes.sphere_midpoint(BOB).check(BOB.state([1.0, 0, 0], velocity=[0, 0, 1.0]), 50.0),
        "does not converge",
    ),
    (lambda: APOPHIS.state_from_periods(**PERIODS, long_axis="long"), "long_axis must be True"),
    (lambda: group_midpoint(SL3, maps.cayley), "Cayley map does not land in SL"),
    (lambda: group_midpoint(SL3, maps.arcsine), "one pair of nonzero eigenvalues"),
    (lambda: group_midpoint(LEFT, lambda g, x: g.exp(2 * x)), "must be the identity"),
    (lambda: group_midpoint(LEFT, lambda g, x: g.exp(x) * (1 + jnp.sum(x * x))), r"τ\(Θ\) must lie in so3; "),
]
ROOMS = {
    "torques": LAWS,
    "satellites": SATELLITES,
    "orbits": ORBITS,
    "potentials": POTENTIALS,
    "shapes": SHAPES,
    "rods": RODS,
    "bodies": MANY_BODIES,
    "systems": SYSTEMS,
    "schemes": SCHEMES,
    "runs": RUNS,
    "others": OTHERS,
}
ROWS = [pytest.param(*row, id=f"{room}-{k}") for room, table in ROOMS.items() for k, row in enumerate(table)]
ROWS += [pytest.param(*row, id=f"long-{k}", marks=pytest.mark.long) for k, row in enumerate(LONG)]


@pytest.mark.parametrize(("call", "sentence"), ROWS)
def test_bad_arguments_are_refused_in_a_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


@pytest.mark.parametrize(
    ("error", "call", "sentence"),
    [
        (TypeError, lambda: FIELD + 1.0, "a potential is added to potentials"),
        (TypeError, lambda: BODY.state(ONE, E3, 2), f"attitude may come first without a name, and {MOTIONS} need the"),
        (
            TypeError,
            lambda: SATELLITE.state(ONE, E3),
            rf"{MOTIONS}, t, work need theirs: state\(attitude, angular_velo",
        ),
        (TypeError, lambda: torqued_body(J, VISCOUS_TORQUE).state(ONE, ONE), MOTIONS),
        (TypeError, lambda: jax.jit(batch)(MANY), r"li\.run computes with numbers.*inside of them use li\.integrate"),
        (TypeError, lambda: BOB.state(), "missing a required argument: 'direction'"),
        (TypeError, lambda: orbits.secular_j2(*[0.1] * 10), "positional arguments but"),
        (TypeError, lambda: orbits.kepler(*[0.1] * 8), "positional arguments but"),
        (TypeError, lambda: li.elliptic.E(0.1, 0.2, 0.3), r"E\(m\) or E\(phi, m\)"),
        (TypeError, lambda: SOLID(EYE, EYE), r"systems\.rigid_bodies"),
        (ZeroDivisionError, lambda: systems.gravity_gradient(J, lambda t: 1 / 0, 1.0), None),
    ],
)
def test_errors_of_other_types(error, call, sentence):
    with pytest.raises(error, match=sentence):
        call()
