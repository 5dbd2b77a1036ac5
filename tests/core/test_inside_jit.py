"""What is made inside jit from arrays made outside: systems, potentials, shapes and runs, checked as outside."""

import jax
import jax.numpy as jnp
import pytest

import lieint_jax as li
from lieint_jax import orbits, potentials, schemes, shapes, systems, tides, torques

ONE, PAIR, THREE, UNIT = jnp.array(1.0), jnp.array([1.0, 2.0]), jnp.array([1.0, 2.0, 2.5]), jnp.array([0.0, 0.0, 1.0])
INERTIAS = jnp.stack([THREE, THREE])
WHEELS = jnp.eye(3)
PLACES = jnp.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])
CORNERS = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
NEGATIVE, NOTHING = -PAIR, jnp.zeros(3)
QUATERNION = jnp.array([1.0, 0.0, 0.0, 0.0])
TOP = systems.potential_top(THREE, lambda Gamma: Gamma[0])
THERMOSTAT = schemes.langevin(TOP, 1.0, 0.5)
NO_KEY = jnp.full(4, 0.5)
WARM = THERMOSTAT.start(TOP.state(QUATERNION, angular_velocity=THREE), key=0)

MADE = {
    "springs": lambda: potentials.springs([[0, 1]], PLACES[None, :, 0], ONE, ONE),
    "ellipsoid_sphere": lambda: potentials.ellipsoid_sphere(ONE, PAIR, THREE),
    "maccullagh": lambda: potentials.maccullagh(ONE, PAIR, INERTIAS),
    "mutual_gravity": lambda: potentials.mutual_gravity(ONE, [shapes.box(THREE, mass=ONE), ONE]),
    "polyhedron": lambda: systems.rigid_bodies(PAIR / 6, INERTIAS, potentials.polyhedron(ONE, (CORNERS, FACES), ONE)),
    "point_masses": lambda: potentials.point_masses(ONE, PAIR, softening=ONE),
    "point_charges": lambda: potentials.point_charges(ONE, PAIR),
    "lennard_jones": lambda: potentials.lennard_jones(PAIR, PAIR),
    "uniform_field": lambda: potentials.uniform_field(UNIT, PAIR),
    "water": lambda: potentials.water().inertia,
    "box": lambda: shapes.box(THREE, density=ONE),
    "ellipsoid": lambda: shapes.ellipsoid(THREE, mass=ONE),
    "cylinder": lambda: shapes.cylinder(ONE, ONE, mass=ONE),
    "sites": lambda: shapes.sites(jnp.ones(4), CORNERS),
    "mesh": lambda: shapes.mesh(CORNERS, FACES, mass=ONE),
    "constant_lag": lambda: tides.constant_lag(ONE, PAIR, PAIR, PAIR, PAIR),
    "rigid_body": lambda: systems.rigid_body(THREE).state(QUATERNION, angular_velocity=THREE),
    "heavy_top": lambda: systems.heavy_top(THREE, THREE, UNIT).state(QUATERNION, spatial_momentum=THREE),
    "gyrostat": lambda: systems.gyrostat(THREE, THREE),
    "embedded_body": lambda: systems.embedded_body(THREE),
    "damped_body": lambda: systems.damped_body(THREE, ONE),
    "pendulum": lambda: systems.pendulum(ONE, ONE).state(UNIT, velocity=QUATERNION[:3]),
    "rigid_bodies": lambda: systems.rigid_bodies(PAIR, INERTIAS, potentials.point_masses(ONE, PAIR)),
    "gravity_gradient": lambda: systems.gravity_gradient(THREE, orbits.kepler(1.0, 1.0, 0.1)),
    "torques": lambda: torques.unloading(WHEELS, ONE, UNIT),
    "so3_midpoint": lambda: schemes.so3_midpoint(systems.rigid_body(THREE)),
    "langevin": lambda: li.integrate(THERMOSTAT, WARM, 0.01, 2),
    "events": lambda: li.event(
        schemes.splitting(TOP), WARM._replace(extra=None), 0.01, lambda z: z.p[0] - 2, max_steps=3
    ),
}
REFUSED = {
    "ellipsoid_sphere": lambda: potentials.ellipsoid_sphere(ONE, NEGATIVE, THREE),
    "uniform_field": lambda: potentials.uniform_field(NOTHING, PAIR),
    "box": lambda: shapes.box(NOTHING, mass=ONE),
    "langevin": lambda: THERMOSTAT.check(WARM._replace(extra=WARM.extra | {"key": NO_KEY}), ONE),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_objects_can_be_made_inside_jit_from_arrays_made_outside(name):
    assert jax.eval_shape(lambda: jax.tree.leaves(MADE[name]()))


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_numbers_are_refused_inside_jit_too(name):
    for make in (REFUSED[name], lambda: jax.eval_shape(lambda: jax.tree.leaves(REFUSED[name]()))):
        with pytest.raises(ValueError, match="must"):
            make()


BODY = systems.rigid_body(THREE)
STEP = schemes.so3_explicit(BODY)
STATES = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.stack([THREE, UNIT]))
TRANSFORMATIONS = {
    "grad": lambda f: jax.grad(f)(1.0),
    "jvp": lambda f: jax.jvp(f, (1.0,), (1.0,)),
    "vmap": lambda f: jax.vmap(f)(PAIR),
    "jit": lambda f: jax.jit(f)(1.0),
}


ENSEMBLES = {
    "states": lambda x: li.run(STEP, STATES._replace(p=x * STATES.p), 0.1, 1, save_every=None),
    "step": lambda x: li.run(schemes.so3_explicit(systems.RigidBody(x * THREE)), STATES, 0.1, 1, save_every=None),
    "dt": lambda x: li.run(STEP, STATES, 0.1 * x, 1, save_every=None),
    "times": lambda x: li.run(STEP, STATES, times=x * PAIR, save_every=None),
    "function": lambda x: li.run(STEP, lambda m: STATES._replace(p=x * STATES.p), 0.1, 1, members=2, save_every=None),
}


@pytest.mark.parametrize("ensemble", ENSEMBLES.values(), ids=ENSEMBLES)
@pytest.mark.parametrize("transformation", TRANSFORMATIONS.values(), ids=TRANSFORMATIONS)
def test_an_ensemble_inside_a_transformation_is_refused_by_a_sentence(transformation, ensemble):
    with pytest.raises(TypeError, match=r"^li\.run computes with numbers, outside of .* use li\.integrate"):
        transformation(lambda x: ensemble(x).state.p.sum())


@pytest.mark.long
def test_an_ensemble_of_numbers_runs_inside_a_derivative_and_not_inside_jit():
    """Numbers are computed at once there; in jit everything is traced."""
    slope = jax.grad(lambda x: x * li.run(STEP, STATES, 0.1, 1, save_every=None).t[-1])(1.0)
    assert slope == pytest.approx(0.1, rel=1e-15, abs=0)
    with pytest.raises(TypeError, match=r"use li\.integrate"):
        jax.jit(lambda: li.run(STEP, STATES, 0.1, 1, save_every=None).t)()
