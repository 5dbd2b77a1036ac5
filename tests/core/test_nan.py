"""NaN in, NaN out: every public function of a time, an orbit or a field, inside jit.

A comparison, `where`, `clip` or a branch can replace a NaN by a number: sunlight beyond the end of an ephemeris. Each
floating argument in turn is NaN, and every output that it changes must be NaN. What it changes is found by trial.
"""

import inspect

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax import attitude, maps, measure, orbits, potentials, shapes, tides, torques
from lieint_jax.groups import so3
from lieint_jax.types import Rotation

MODULES = (attitude, orbits, torques, potentials, maps, measure, shapes, tides)
T, Q, OMEGA = 0.7, so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2])), jnp.array([0.5, -0.3, 0.6])
J = jnp.array([1.3, 1.7, 2.2])
ELEMENTS = dict(mu=1.3, semi_major_axis=1.1, eccentricity=0.1, inclination=0.7)
ANGLES = dict(node=0.4, periapsis=0.2, periapsis_time=0.1)
TIMES = jnp.linspace(-1.0, 2.0, 5)
ROWS = jnp.sin(jnp.arange(15.0)).reshape(5, 3)
AXES = torques.wheel_pyramid(0.6)
POSITIONS = jnp.array([[0.0, 0.1, 0.2], [4.0, 1.0, -0.5]])
ROTATIONS = jnp.stack([so3.to_matrix(Q), so3.to_matrix(so3.inverse(Q))])
BENT = jnp.stack([so3.to_matrix(so3.multiply(Q, so3.exp(x * jnp.array([0.3, -0.2, 0.4])))) for x in (1.0, 2.0)])
SITES = [jnp.array([[0.1, 0.2, 0.0], [-0.1, 0.0, 0.1]]), jnp.array([[0.0, 0.2, 0.1]])]
TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def circle(r):
    """An orbit of radius r, as a function of time."""
    return lambda s: (r * jnp.stack([jnp.cos(s), jnp.sin(s), 0 * s]), r * jnp.stack([-jnp.sin(s), jnp.cos(s), 0 * s]))


def turning(b):
    return lambda s: b * jnp.stack([jnp.cos(s), jnp.sin(s), 1 + 0 * s])


def torque(make, inner=None):
    """A law's mean torque, work and internal state after a step, and what it gives at an instant."""

    def function(t, dt, q, omega, inner=None, **arguments):
        law = make(**arguments)
        q = so3.normalize(q)
        h = dt / 2 * omega
        end = so3.normalize(so3.multiply(q, jnp.concatenate([jnp.ones(1), h])))
        middle = so3.normalize(q + end)
        rotation = Rotation(t, dt, q, middle, end, h, jnp.ones(()), omega, so3.Ad(q, omega))
        mean, after = law.mean(rotation, inner)
        now = Rotation.at_instant(t, q, omega, so3.Ad(q, omega))
        instant = law.start(now), law.energy(t, q, inner), None if inner is None else law.inner_rate(now, inner)
        return mean, after, law.work(rotation, mean, inner, after), instant

    def case(**arguments):
        return function, dict(t=T, dt=0.1, q=Q, omega=OMEGA, inner=inner, **arguments)

    return case


def orbit_case(make, **arguments):
    return lambda t, **given: make(**given)(t), dict(t=T, **arguments)


TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def pair_case(make, **arguments):
    return lambda x, R, **given: make(**given)(x, R), dict(x=POSITIONS, R=ROTATIONS) | arguments


def wheel_law(axes, inertias, gain, max_torque, max_momentum):
    motor = lambda t, q, omega, h: -gain * h  # noqa: E731
    return torques.wheels(axes, inertias, motor, max_torque, max_momentum=max_momentum, speeds=1.0)


def motor(axes, gain, h):
    return torques.wheel_motor(axes, torques.viscous(gain), gyroscopic=True)(jnp.array(T), Q, OMEGA, h)


def plates(make):
    return lambda r, sizes, center, **given: make(r, *torques.box_plates(sizes, center), **given)


BOX = dict(sizes=jnp.array([1.0, 0.5, 0.4]), center=jnp.array([0.05, -0.1, 0.08]))
FIELD, THETA = jnp.array([0.1, 0.2, -0.9]), jnp.array([0.3, -0.5, 0.7])
SUN = jnp.array([0.6, 0.8, 0.0])
EARTH = dict(r=1.2, radius=0.8, rate=0.06)
NIGHT = dict(r=1.2, sun=jnp.array([-0.6, -0.7, 0.1]), radius=0.8)
AIR = dict(density=0.3, scale_height=0.1, height=0.1)
MASSES, RADII = jnp.array([2.0, 1.0]), jnp.array([0.4, 0.2])
CORNERS = jnp.array([[0.0, 0.1, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.2]])
CASES = {
    **{f"attitude.{name}": (getattr(attitude, name), dict(q=Q)) for name in attitude.__all__ if name != "to_euler"},
    "attitude.to_euler": (lambda q: attitude.to_euler("ZYX", q), dict(q=Q)),
    "attitude.from_euler": (lambda angles: attitude.from_euler("zxz", angles), dict(angles=THETA)),
    "attitude.from_matrix": (attitude.from_matrix, dict(R=ROTATIONS[0])),
    "attitude.from_mrp": (attitude.from_mrp, dict(sigma=THETA)),
    "attitude.from_rotvec": (attitude.from_rotvec, dict(rotvec=THETA)),
    "orbits.kepler": orbit_case(orbits.kepler, **ELEMENTS, **ANGLES),
    "orbits.kepler hyperbola": orbit_case(orbits.kepler, mu=1.3, semi_major_axis=-1.1, eccentricity=1.3, **ANGLES),
    "orbits.from_state": orbit_case(orbits.from_state, mu=1.3, position=ROWS[0], velocity=ROWS[1]),
    "orbits.from_state elements": (
        lambda mu, r, v: jax.tree.leaves(orbits.from_state(mu, r, v).elements),
        dict(mu=1.3, r=ROWS[0], v=ROWS[1]),
    ),
    "orbits.hyperbola": orbit_case(orbits.hyperbola, mu=1.3, distance=0.4, speed=0.7),
    "orbits.encounter_speed": (orbits.encounter_speed, dict(semi_major_axis=1.1, eccentricity=0.3, inclination=0.2)),
    "orbits.secular_j2": orbit_case(orbits.secular_j2, **ELEMENTS, **ANGLES, J2=0.1, radius=0.3),
    "orbits.table": orbit_case(orbits.table, times=TIMES, positions=ROWS, velocities=ROWS[::-1]),
    "orbits.vector_table": orbit_case(orbits.vector_table, times=TIMES, values=ROWS),
    "orbits.earth_rotation_angle": (orbits.earth_rotation_angle, dict(date=2451545.3)),
    "orbits.earth_field": orbit_case(
        lambda r, coefficients, **more: orbits.earth_field(circle(r), 2460676.5, coefficients, **more),
        **EARTH,
        coefficients=FIELD,
    ),
    "orbits.atmosphere": orbit_case(lambda r, **more: orbits.atmosphere(circle(r), **more), **EARTH, **AIR),
    "orbits.sun_direction": orbit_case(orbits.sun_direction, date=2460676.5, day=0.1),
    "orbits.lvlh": (
        lambda t, r: (orbits.lvlh(circle(r))(t), orbits.lvlh(circle(r)).angular_velocity(t)),
        dict(t=T, r=jnp.array([1.0, 1.1, 1.2])),
    ),
    **{
        f"orbits.eclipse {shadow}": orbit_case(
            lambda r, shadow=shadow, **more: orbits.eclipse(circle(r), shadow=shadow, **more), **NIGHT, angle=0.3
        )
        for shadow in ("conical", "cylindrical")
    },
    "torques.viscous": torque(torques.viscous)(damping=J),
    "torques.kane_damper": torque(torques.kane_damper, OMEGA[::-1])(inertia=0.3, damping=0.2),
    "torques.internal_friction": (
        lambda a, Pi, Omega: torques.internal_friction(a, tuple(Pi), tuple(Omega)),
        dict(a=0.1, Pi=OMEGA[::-1], Omega=OMEGA),
    ),
    "torques.dipole": torque(lambda moment, b: torques.dipole(moment, turning(b)))(moment=THETA, b=FIELD),
    "torques.gravity_gradient": torque(lambda mu, inertia, r: torques.gravity_gradient(circle(r), inertia, mu))(
        mu=1.3, inertia=J, r=1.2
    ),
    "torques.potential": torque(lambda b, k: torques.potential(lambda G, t: k * G[0] * G[1] * jnp.cos(t), turning(b)))(
        b=FIELD, k=0.7
    ),
    "torques.bdot": torque(lambda gain, b: torques.bdot(gain, turning(b)))(gain=0.4, b=FIELD),
    "torques.bdot limited": torque(lambda gain, b, limit: torques.bdot(gain, turning(b), limit))(
        gain=0.4, b=FIELD, limit=jnp.array([0.1, 0.2, 0.3])
    ),
    "torques.eddy_current": torque(lambda k, b, rate: torques.eddy_current(k, turning(b), turning(rate)))(
        k=J, b=FIELD, rate=THETA
    ),
    "torques.eddy_current in a slow field": torque(lambda k, b: torques.eddy_current(k, turning(b)))(k=0.4, b=FIELD),
    "torques.sampled": torque(lambda gain, period: torques.sampled(torques.viscous(gain), period), THETA)(
        gain=0.4, period=0.2
    ),
    "torques.hysteresis": torque(lambda b, **more: torques.hysteresis(field=turning(b), **more), jnp.array(0.2))(
        b=FIELD, axis=SUN, saturation=0.3, slope=0.2, coercivity=0.1
    ),
    "torques.pd_trace": torque(torques.pd_trace)(gain=0.3, damping=0.2, target=Q[::-1]),
    "torques.pd_quaternion": torque(torques.pd_quaternion)(gain=0.3, damping=0.2, target=Q[::-1]),
    "torques.pointing": torque(
        lambda r, gain, damping, inertia, offset: torques.pointing(
            orbits.lvlh(circle(r)), gain, damping, inertia, offset=offset
        )
    )(r=1.2, gain=0.3, damping=0.2, inertia=J, offset=Q),
    "torques.sliding_mode": torque(
        lambda r, inertia, slope, rate, **more: torques.sliding_mode(
            orbits.lvlh(circle(r)), inertia, slope, rate, **more
        )
    )(r=1.2, inertia=J, slope=0.7, rate=0.2, layer=0.4, offset=Q),
    "torques.saturated": torque(lambda gain, limit: torques.saturated(torques.viscous(gain), limit))(
        gain=0.4, limit=jnp.array([0.1, 0.2, 0.3])
    ),
    "torques.windowed": torque(lambda gain, **window: torques.windowed(torques.viscous(gain), **window))(
        gain=0.4, start=0.0, stop=9.0
    ),
    "torques.total": torque(lambda a, b: torques.total([torques.viscous(a), torques.viscous(b)]).laws[1])(a=0.1, b=0.2),
    "torques.thruster": torque(torques.thruster)(torque=THETA, start=0.72, stop=0.77),
    "torques.thruster at an instant": (
        lambda t, **more: torques.thruster(**more)(t, Q, OMEGA),
        dict(t=T, torque=THETA, start=0.6, stop=0.8),
    ),
    "torques.torquers": torque(lambda gain, b, limit: torques.torquers(torques.viscous(gain), turning(b), limit))(
        gain=0.4, b=FIELD, limit=0.1
    ),
    "torques.unloading": torque(
        lambda axes, gain, b, limit, bias: torques.unloading(axes, gain, turning(b), limit, bias=bias),
        jnp.array([0.3, -0.2, 0.1, 0.4]),
    )(axes=AXES, gain=0.4, b=FIELD, limit=0.1, bias=0.05),
    "torques.wheels": torque(wheel_law, jnp.array([0.3, -0.2, 0.1, 0.4]))(
        axes=AXES, inertias=0.05, gain=0.4, max_torque=0.1, max_momentum=0.5
    ),
    "torques.wheel_motor": (motor, dict(axes=AXES, gain=0.3, h=jnp.array([0.3, -0.2, 0.1, 0.4]))),
    "torques.wheel_pyramid": (torques.wheel_pyramid, dict(tilt=0.6)),
    "torques.allocation": (torques.allocation, dict(axes=AXES)),
    "torques.body_inertia": (torques.body_inertia, dict(locked=J, axes=AXES, inertias=jnp.full(4, 0.05))),
    "torques.box_plates": (torques.box_plates, BOX),
    "torques.aerodynamic": torque(
        plates(
            lambda r, areas, normals, arms, drag: torques.aerodynamic(
                orbits.atmosphere(circle(r), **AIR, radius=0.8, rate=0.06), areas, normals, arms, drag=drag
            )
        )
    )(r=1.2, drag=2.2, **BOX),
    "torques.solar_plate": torque(lambda s, **more: torques.solar_plate(sun=turning(s), **more))(
        s=SUN, force=0.4, normal=SUN, arm=THETA, specular=0.3, diffuse=0.2
    ),
    "torques.solar_plates": torque(
        plates(
            lambda r, force, normals, arms, angle, specular: torques.solar_plates(
                force, normals, arms, SUN, specular=specular, light=orbits.eclipse(circle(r), -SUN, 0.8, angle=angle)
            )
        )
    )(r=1.2, angle=0.5, specular=0.3, **BOX),
    "potentials.ellipsoid_sphere": pair_case(
        potentials.ellipsoid_sphere, G=1.3, masses=MASSES, semi_axes=jnp.array([1.0, 0.8, 0.3])
    ),
    "potentials.maccullagh": pair_case(potentials.maccullagh, G=1.3, masses=MASSES, inertias=jnp.stack([J, 0.1 * J])),
    "potentials.mutual_gravity": pair_case(
        lambda G, edges, a: potentials.mutual_gravity(G, [shapes.box(edges, mass=2.0), shapes.ellipsoid(a, mass=1.0)]),
        G=1.3,
        edges=jnp.array([0.3, 0.2, 0.1]),
        a=jnp.array([0.2, 0.3, 0.1]),
    ),
    "potentials.polyhedron": pair_case(
        lambda G, corners, density, mass, J: potentials.polyhedron(G, (corners, TETRAHEDRON), density).with_bodies(
            jnp.stack([1.0, mass]), jnp.stack([jnp.ones(3), J])
        ),
        G=1.3,
        corners=jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        density=1.5,
        mass=0.7,
        J=J,
    ),
    "potentials.rod": pair_case(
        lambda ell, GA, EI, k: potentials.rod(ell, GA, EI, k),
        ell=jnp.array([0.7]),
        GA=jnp.array([1.3, 1.1, 2.0]),
        EI=jnp.array([0.3, 0.4, 0.2]),
        k=THETA,
        R=BENT,
    ),
    "potentials.held": pair_case(
        lambda ell, EI, pose: potentials.held(potentials.rod(jnp.stack([ell, ell]), EI, EI), pose),
        ell=0.7,
        EI=jnp.array([0.3, 0.4, 0.2]),
        pose=jnp.concatenate([THETA, Q]),
        R=BENT,
    ),
    "potentials.springs": pair_case(
        lambda points, stiffness, lengths: potentials.springs([[0, 1]], points, stiffness, lengths),
        points=jnp.stack([SITES[0]]),
        stiffness=0.3,
        lengths=0.4,
    ),
    **{
        f"potentials.{name}": pair_case(
            lambda k, a, b, soft, name=name: getattr(potentials, name)(k, [a, b], SITES, soft),
            k=1.3,
            a=jnp.array([0.3, 0.4]),
            b=jnp.array([0.7]),
            soft=0.1,
        )
        for name in ("point_charges", "point_masses")
    },
    "potentials.lennard_jones": pair_case(
        lambda a, b, s, r: potentials.lennard_jones([a, b], [s, r], SITES),
        a=jnp.array([0.3, 0.4]),
        b=jnp.array([0.7]),
        s=jnp.array([0.3, 0.4]),
        r=jnp.array([0.7]),
    ),
    "potentials.sites": pair_case(
        potentials.sites,
        points=jnp.stack([SITES[0]] * 2),
        charges=jnp.array([0.3, -0.4]),
        wells=jnp.array([0.2, 0.7]),
        sizes=jnp.array([0.3, 0.5]),
        constant=1.3,
    ),
    "potentials.uniform_field": pair_case(
        lambda field, a, b: potentials.uniform_field(field, [a, b], SITES),
        field=THETA,
        a=jnp.array([0.3, 0.4]),
        b=jnp.array([0.7]),
    ),
    "potentials.outer_field": pair_case(
        lambda k, a, b: potentials.outer_field(lambda x: k * x[0] * x[1], [a, b], SITES),
        k=1.3,
        a=jnp.array([0.3, 0.4]),
        b=jnp.array([0.7]),
    ),
    "potentials.force": (
        lambda x, R: potentials.force(potentials.rod([1.0], (1.0, 1, 2), (1.0, 1, 1)), x, R),
        dict(x=jnp.eye(2, 3), R=BENT),
    ),
    "potentials.torques": (potentials.torques, dict(R=ROTATIONS, along_R=ROTATIONS[::-1] + 0.1)),
    **{
        f"maps.{map_.__name__}": (lambda theta, map_=map_: map_(so3, theta), dict(theta=THETA))
        for map_ in (maps.exponential, maps.cayley, maps.arcsine)
    },
    **{f"maps.{name}": (getattr(maps, name), dict(x=0.4)) for name in maps.__all__ if name.startswith("kappa_")},
    "maps.scaled_cayley": (lambda theta: maps.scaled_cayley(maps.kappa_symplectic)(so3, theta), dict(theta=THETA)),
    "maps.derivative": (lambda theta: maps.derivative(maps.cayley, so3, theta), dict(theta=THETA)),
    **{
        f"shapes.{name}": (lambda name=name, **given: getattr(shapes, name)(**given), dict(mass=2.0, **x))
        for name, x in {
            "box": dict(edges=J),
            "ellipsoid": dict(semi_axes=J),
            "cylinder": dict(radius=0.4, height=0.7),
        }.items()
    },
    "shapes.facets": (lambda at: vars(shapes.facets(at, TETRAHEDRON)), dict(at=CORNERS)),
    "shapes.ellipsoid_facets": (lambda a: vars(shapes.ellipsoid_facets(a, 2)), dict(a=J)),
    "shapes.box_facets": (lambda a: vars(shapes.box_facets(a)), dict(a=J)),
    "measure.brightness": (
        lambda q, sun, observer, a: measure.brightness(shapes.ellipsoid_facets(a, 2), so3.normalize(q), sun, observer),
        dict(q=Q, sun=SUN, observer=THETA, a=J),
    ),
    "measure.glossy_brightness": (
        lambda q, sun, observer, surfaces: measure.glossy_brightness(
            shapes.GlossyFacets(jnp.eye(3), *surfaces), so3.normalize(q), sun, observer
        ),
        dict(
            q=Q, sun=SUN, observer=OMEGA, surfaces=jnp.array([[1, 2, 3], [0.3, 0.4, 0.5], [0.1, 0.2, 0.3], [2, 3, 4]])
        ),
    ),
    "measure.lambert": (measure.lambert, dict(mu0=0.3, mu=0.4)),
    "measure.mean_rate": (measure.mean_rate, dict(t=TIMES, angle=ROWS)),
    "measure.orbit_axes": (lambda t, r: measure.orbit_axes(circle(r), t), dict(t=T, r=1.2)),
    "shapes.mesh": (lambda at, mass: shapes.mesh(at, TETRAHEDRON, mass=mass), dict(at=CORNERS, mass=2.0)),
    "shapes.body": (shapes.body, dict(mass=2.0, inertia=J, center=THETA)),
    "shapes.sites": (shapes.sites, dict(masses=MASSES, points=POSITIONS)),
    **{
        f"tides.{name}": (
            lambda r, v, w, name=name, **law: getattr(tides, name)(**law).between(0, 1)(r, v, w, w[::-1]),
            dict(r=POSITIONS[1], v=THETA, w=OMEGA, G=1.3, masses=MASSES, radii=RADII, k2=jnp.array([0.1, 0.3]), **law),
        )
        for name, law in {"constant_lag": dict(lags=0.1), "constant_q": dict(Q=30.0, threshold=0.1)}.items()
    },
}
NO_NUMBERS = data_files.table("no_numbers")


def public_functions():
    for module in MODULES:
        for name in module.__all__:
            found = getattr(module, name)
            called = inspect.isfunction(found) or (inspect.isclass(found) and name[0].islower())
            if called or isinstance(found, maps.Kappa):
                yield f"{module.__name__.removeprefix('lieint_jax.')}.{name}"


def test_every_public_function_is_listed():
    assert {name.split()[0] for name in CASES} | set(NO_NUMBERS) == set(public_functions())


def changed(x, index):
    """x with other numbers at an index, the last of which is NaN."""
    return [x.at[index].set(x[index] * f + (f - 1) / 10) for f in (0.2, 1.7, -1.0, jnp.nan)]


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_nan_in_nan_out(name):
    function, given = CASES[name]
    given = {key: jnp.asarray(x, float) for key, x in given.items() if x is not None}
    places = [(key, index) for key, x in given.items() for index in np.ndindex(x.shape)]
    tried = [given | {key: x} for key, index in places for x in changed(given[key], index)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), given, *tried)

    @jax.jit
    @jax.vmap
    def outputs(arguments):
        leaves = jax.tree.leaves(function(**arguments))
        return jnp.concatenate([jnp.ravel(x).astype(float) for x in leaves])

    first, *rest = np.asarray(outputs(stacked))
    assert np.isfinite(first).all()
    for (key, index), found in zip(places, np.reshape(rest, (len(places), 4, -1)), strict=True):
        depends = (found[:3] != first).any(axis=0)
        assert np.isnan(found[3][depends]).all(), f"NaN at {key}{list(index)}: {first}, {found}"
