"""Arrays with masked entries, and quantities with units, are refused by name wherever numbers are given.

NumPy converts both silently: a masked entry to what stands behind the mask, a length in km to its bare number. So each
argument of each public function that takes numbers is given once with a mask and twice with a unit.
"""

import functools
import inspect
import re

import calls
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cubes import CUBE, FACES

import lieint_jax as li
from lieint_jax import (
    attitude,
    diagnostics,
    elliptic,
    fitting,
    groups,
    measure,
    orbits,
    schemes,
    shapes,
    systems,
    tides,
)

NUMBERS = re.compile(
    r"ArrayLike|\bArray\b|ndarray|Attitude|Directions|\bfloat\b|Scalar|Vector|Positions|Rotations|\bTime\b"
)
MODULES = (attitude, diagnostics, elliptic, fitting, groups, measure, *calls.ROOMS, schemes, shapes, systems, tides)
TOP_LEVEL = ("integrate", "event", "interpolate", "run", "transition")
CALLED = {"locked": "inertia", "window": "start", "states": "state"}  # in errors, by another name
NO_NUMBERS = {  # whose numbers are options, or those of functions and states
    "elliptic.E",
    "elliptic.Pi",
    "fitting.fit",  # the residuals below
    "potentials.at_time",
    "potentials.given_poses",
    "potentials.mutual_gravity",
    "potentials.polyhedron",
    "shapes.obj",
    "systems.clebsch_integral",
}


class WithUnit:
    """Numbers with a unit, as astropy has them; `units`, as pint and xarray have them."""

    def __init__(self, value, **unit):
        self.value = np.asarray(value)
        self.__dict__.update(unit, shape=self.value.shape, ndim=self.value.ndim, dtype=self.value.dtype)

    def __array__(self, dtype=None, copy=None):
        return np.array(self.value, dtype)

    def __float__(self):
        return float(self.value)

    def __len__(self):
        return len(self.value)

    def __getitem__(self, index):
        return WithUnit(self.value[index], **{k: v for k, v in vars(self).items() if k.startswith("unit")})


def masked(value):
    value = np.asarray(value, float)
    mask = np.zeros(value.shape, bool)
    mask[(0,) * value.ndim] = True
    return np.ma.array(value, mask=mask)


KINDS = {
    "mask": (masked, "1 masked entries of"),
    "unit": (lambda value: WithUnit(value, unit="km"), "got WithUnit with the unit 'km'"),
    "units": (lambda value: WithUnit(value, units="km"), "got WithUnit with the unit 'km'"),
}
J, Q, V, W = np.array([1.0, 2.0, 2.5]), np.array([1.0, 0, 0, 0]), np.array([0.6, 0.0, 0.8]), np.array([0.3, 0.2, 1.0])
T, X = np.linspace(0.0, 5.0, 41), np.sin(np.linspace(0.0, 30.0, 41))


@functools.cache
def body():
    return systems.rigid_body(J)


@functools.cache
def step():
    return schemes.so3_midpoint(body())


@functools.cache
def state():
    return body().state(angular_velocity=W)


@functools.cache
def run():
    return li.run(step(), state(), 0.05, 40)


def run_of_several():
    bodies = attracting()
    state = bodies.state(np.array([[0.0, 0, 0], [3.0, 0, 0]]), angular_velocities=np.stack([W, W]))
    return li.run(schemes.splitting(bodies), state, 0.05, 2)


def facets():
    return shapes.box_facets([1.0, 2.0, 3.0])


def glossy():
    found = facets()
    n = np.ones(len(found.areas))
    return shapes.GlossyFacets(found.normals, found.areas, n, 0.1 * n, 2 * n)


def pendulum():
    return systems.pendulum(1.0, 2.0)


def top():
    return systems.heavy_top(J, V)


def attracting():
    both = li.potentials.point_masses(1.0, [1.0, 0.5])
    return systems.rigid_bodies(np.array([1.0, 0.5]), np.stack([J, J]), both)


def spinning():
    return body().state(angular_velocity=[0, 0, 1.0])


def potential(x, R):
    return jnp.sum(x[0] * x[1])


def kepler_orbit():
    return orbits.kepler(1.0, 1.0, 0.1)


# the arguments of a call, or a function that makes them
CALLS = {
    "li.integrate": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=2, save_at=None),
    "li.integrate at given times": lambda: dict(step=step(), state=state(), times=np.array([0.0, 0.1])),
    "li.integrate to given times": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=2, save_at=T[:1]),
    "li.run": lambda: dict(step=step(), states=state(), dt=0.1, num_steps=2),
    "li.run at given times": lambda: dict(step=step(), states=state(), times=np.array([0.0, 0.1])),
    "li.run to given times": lambda: dict(step=step(), states=state(), dt=0.1, num_steps=2, save_at=T[:1]),
    "li.event": lambda: dict(step=step(), state=state(), dt=0.1, condition=lambda z: z.p[0], max_steps=3),
    "li.interpolate": lambda: dict(system=body(), trajectory=li.integrate(step(), state(), 0.05, 4), times=T[:1]),
    "li.transition": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=2),
    "li.integrate (steps undone)": lambda: dict(
        step=step(), state=state(), dt=0.1, save_at=T[1:2], adjoint=li.ReversibleAdjoint()
    ),
    "attitude.from_euler": dict(sequence="ZYX", angles=V),
    "attitude.to_euler": dict(sequence="ZYX", q=Q),
    "attitude.from_matrix": dict(R=np.eye(3)),
    "attitude.from_mrp": dict(sigma=V),
    "attitude.from_rotvec": dict(rotvec=V),
    **{f"attitude.{name}": dict(q=Q) for name in attitude.__all__ if "scalar" in name or name.startswith("to_m")},
    "attitude.to_rotvec": dict(q=Q),
    "diagnostics.certify": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=4),
    "diagnostics.round_trip_error": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=2),
    "diagnostics.conditions": lambda: dict(step=step(), state=state(), dt=0.1),
    "diagnostics.equilibrium": lambda: dict(system=body(), guess=spinning(), frame=np.array([0, 0, 1.0])),
    "diagnostics.normal_modes": lambda: dict(system=body(), state=spinning(), frame=np.array([0, 0, 1.0])),
    "diagnostics.exponent_of_neighbors": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=40, distance=1e-8),
    "diagnostics.exponents_of_flow": lambda: dict(system=body(), state=state(), t=1.0, pieces=2),
    "diagnostics.flow": lambda: dict(system=body(), state=state(), t=1.0, num_steps=2),
    "diagnostics.lyapunov": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=4, vectors=np.eye(6)[:, :2]),
    "diagnostics.megno": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=4, vector=np.eye(6)[0]),
    **{
        f"diagnostics.{name}": lambda: dict(step=step(), state=state(), dt=0.1)
        for name in ("linearization", "local_error", "order", "reversibility", "step_cost")
    },
    "diagnostics.modified_energy": lambda: dict(
        step=schemes.splitting(top()), state=top().state(angular_velocity=W), dt=0.1
    ),
    "diagnostics.symplectic_defect": lambda: dict(step=step(), state=state(), dt=0.1),
    "diagnostics.poisson_error": lambda: dict(step=step(), state=state(), dt=0.1, num_steps=2),
    "diagnostics.section": lambda: dict(
        step=step(),
        states=jax.tree.map(lambda x: jnp.stack([x, x]), state()),
        dt=0.1,
        condition=lambda z: z.p[0],
        max_steps=3,
        count=1,
    ),
    "elliptic.RC": dict(x=0.3, y=0.4),
    **{f"elliptic.{name}": dict(x=0.3, y=0.4, z=0.5) for name in ("RD", "RF")},
    "elliptic.RJ": dict(x=0.3, y=0.4, z=0.5, p=0.6),
    "elliptic.F": dict(phi=0.3, m=0.4),
    "elliptic.K": dict(m=0.4),
    **{f"elliptic.{name}": dict(u=0.3, m=0.4) for name in ("sn", "cn", "dn")},
    "fitting.fit": lambda: dict(loss=lambda p: p - 1, params=np.array([0.0, 0.3]), tolerance=1e-8),
    "fitting.interval": dict(low=0.1, high=0.4),
    "fitting.student_t": dict(errors=np.ones((2, 3)), noise=0.3, least=0.1, freedom=4.0),
    "fitting.student_t_weights": dict(errors=np.ones((2, 3)), noise=0.3, freedom=4.0),
    "fitting.student_t_curvature": dict(errors=np.ones((2, 3)), noise=0.3, freedom=4.0),
    "fitting.student_t_noise_error": dict(vectors=3, d=2, freedom=4.0),
    "groups.matrix": dict(basis=np.array([[[0.0, 1.0], [-1.0, 0.0]]])),
    "measure.brightness": lambda: dict(facets=facets(), q=Q, sun=V, observer=W),
    "measure.glossy_brightness": lambda: dict(facets=glossy(), q=jnp.asarray(Q), sun=jnp.asarray(V), observer=V),
    "measure.lambert": dict(mu0=0.3, mu=0.4),
    "measure.light_curve": lambda: dict(run=run(), facets=facets(), sun=V, observer=W),
    "measure.light_changes": lambda: dict(facets=glossy(), sun=np.stack([V, V]), observer=np.stack([W, W])),
    "measure.light_differences": lambda: dict(
        facets=glossy(), q=np.stack([Q, Q]), sun=np.stack([V, V]), observer=np.stack([W, W])
    ),
    "measure.is_light_symmetry": lambda: dict(facets=glossy(), rotation=np.eye(3)),
    "measure.captured_since": dict(t=T, angle=X, limit=0.3),
    "measure.first_below": dict(t=T, x=X, limit=0.3),
    "measure.is_librating": dict(angle=X, bound=1.0),
    "measure.mean_rate": dict(t=T, angle=X),
    "measure.unwrapped": dict(t=T, angle=X, rate=0.1),
    "measure.spectrum": dict(t=T, x=X),
    "measure.line": dict(t=T, x=X, low=0.1, high=2.0),
    "measure.complex_rates": dict(t=T, z=X),
    "measure.periodogram": dict(t=T, x=X, errors=np.ones(41), frequencies=np.linspace(0.1, 2.0, 9)),
    "measure.sines": dict(t=T, x=X, frequencies=np.linspace(0.1, 2.0, 9), count=1),
    "measure.double_periods": dict(t=T, x=X, low=0.1, high=2.0, separation=0.3, step=0.1, order=1, count=1),
    "measure.combination": dict(frequency=0.2, pair=np.array([0.1, 0.3]), order=2, width=0.01),
    "measure.equivalent_pairs": dict(pair=np.array([0.05, 0.08]), low=0.04, high=0.09, most=1),
    "measure.chance_of_match": dict(frequencies=np.array([0.1, 0.3]), low=0.0, high=0.5, width=0.01),
    "measure.pair_density": dict(r=1 + np.abs(X), edges=np.linspace(0.5, 3, 6), peak_below=2.0),
    "measure.distances": lambda: dict(run=run_of_several(), point=V),
    "measure.nutation": lambda: dict(run=run(), axis=V),
    "measure.tilt": lambda: dict(run=run(), axis=V, direction=V),
    "measure.orbit_axes": lambda: dict(orbit=kepler_orbit(), t=0.3),
    "shapes.body": dict(mass=2.0, inertia=J, center=V),
    "shapes.box": dict(edges=J, mass=2.0),
    "shapes.box of a density": dict(edges=J, density=2.0),
    "shapes.box_facets": dict(edges=J),
    "shapes.cylinder": dict(radius=1.0, height=2.0, mass=2.0),
    "shapes.cylinder of a density": dict(radius=1.0, height=2.0, density=2.0),
    "shapes.ellipsoid": dict(semi_axes=J, mass=2.0),
    "shapes.ellipsoid of a density": dict(semi_axes=J, density=2.0),
    "shapes.ellipsoid_facets": dict(semi_axes=J, rings=2),
    "shapes.facets": dict(vertices=np.array(CUBE, float), faces=FACES),
    "shapes.mesh": dict(vertices=np.array(CUBE, float), faces=FACES, mass=2.0),
    "shapes.mesh of a density": dict(vertices=np.array(CUBE, float), faces=FACES, density=2.0),
    "shapes.sites": dict(masses=np.ones(4), points=np.array(CUBE, float)[[0, 1, 3, 5]]),
    "tides.constant_lag": dict(G=1.0, masses=np.ones(2), radii=np.ones(2), k2=np.ones(2), lags=np.ones(2)),
    "tides.constant_lag of times": dict(G=1.0, masses=np.ones(2), radii=np.ones(2), k2=np.ones(2), lags=1.0, times=1.0),
    "tides.constant_q": dict(G=1.0, masses=np.ones(2), radii=np.ones(2), k2=np.ones(2), Q=30.0, threshold=0.1),
    "tides.double_synchronous": dict(G=1.0, masses=np.array([1.0, 0.1]), inertia=0.1, momentum=0.4),
    "systems.circular_section": dict(radius=0.1, young=1.0, density=2.0, poisson=0.3),
    "systems.rectangular_section": dict(width=0.1, height=0.2, young=1.0, density=2.0, poisson=0.3),
    "systems.damped_body": dict(inertia=J, friction=0.1),
    "systems.driven_gyrostat": dict(inertia=J, motor=lambda t: jnp.zeros(3)),
    "systems.driven_top": dict(inertia=J, potential=lambda R, t: t * R[0, 0], axis=V),
    "systems.embedded_body": dict(inertia=J),
    "systems.euler": dict(group=groups.so3, metric=J),
    "systems.gravity_gradient": lambda: dict(inertia=J, orbit=kepler_orbit(), mu=1.0),
    "systems.group_potential": lambda: dict(
        group=groups.special_orthogonal(3), metric=J, potential=lambda q: 0 * q[0, 0], symmetry=np.eye(3)[2:]
    ),
    "systems.gyrostat": dict(inertia=J, rotor=V),
    "systems.heavy_top": dict(inertia=J, weight=V, axis=V),
    "systems.incompressible_body": dict(inertia=J, stored_energy=jnp.trace),
    "systems.kirchhoff": dict(semi_axes=J, center_of_mass=V),
    "systems.maclaurin_modes": dict(eccentricity=0.3),
    "systems.maclaurin_spheroid": dict(eccentricity=0.3),
    "systems.manakov": dict(a=np.array([1.0, 2.0, 3.5, 5.0])),
    "systems.manakov_integrals": dict(a=np.array([1.0, 2.0, 3.5, 5.0]), Pi=jnp.ones(6)),
    **{f"systems.{name}": dict(lam=1.0, mu=2.0) for name in ("mooney_rivlin", "neo_hookean", "saint_venant_kirchhoff")},
    "systems.pendulum": dict(mass=1.0, gravity=2.0, axis=V),
    "systems.potential_top": dict(inertia=J, potential=lambda R: R[0, 0], axis=V),
    "systems.pseudo_rigid_body": dict(inertia=J, stored_energy=jnp.trace, viscosity=0.1),
    "systems.rigid_bodies": dict(masses=np.ones(2), inertias=np.stack([J, J]), potential=potential),
    "systems.rigid_body": dict(inertia=J),
    "systems.rod": lambda: dict(
        length=1.0,
        elements=2,
        section=systems.circular_section(0.1, 1.0, 2.0),
        natural_curvature=V,
        pose=np.array([0.0, 0, 0, 1, 0, 0, 0]),
        gravity=V,
        damping=0.1,
    ),
    "systems.sampled_rate": dict(times=T[:4], rates=np.ones((4, 3))),
    "systems.self_gravity": dict(G=1.0, mass=2.0, radius=3.0),
    "systems.torqued_body": dict(inertia=J, torque=li.torques.viscous(0.1)),
    "systems.tumbling_state": dict(
        moments=np.array([0.55, 0.8, 1.0]),
        precession=20.0,
        rotation=60.0,
        pole=V,
        long_axis=False,
        phi=0.1,
        psi=0.3,
        toward=np.array([1.0, 0, 0]),
    ),
    "schemes.additive": lambda: dict(system=systems.pseudo_rigid_body(J, jnp.trace), alpha=0.5),
    "schemes.extrapolate": lambda: dict(system=body(), order=4.0),
    "schemes.group_alpha": lambda: dict(system=systems.euler(groups.so3, J), alpha=0.5),
    "schemes.kepler_splitting": lambda: dict(system=attracting(), order=(8, 6, 4), G=1.0),
    "schemes.langevin": lambda: dict(system=body(), temperature=1.0, friction=0.1),
    "schemes.log_hamiltonian": lambda: dict(system=top(), energy=0.3),
    "schemes.magnus": lambda: dict(system=systems.kinematics(groups.so3, lambda t: jnp.ones(3)), order=4.0),
    "schemes.nystrom": lambda: dict(system=top(), order=4.0),
    "schemes.so3_alpha": lambda: dict(system=systems.embedded_body(J), alpha=0.5),
    "schemes.compose": lambda: dict(step=step(), order=4.0),
}


FUNCTIONS = {f"li.{name}": getattr(li, name) for name in TOP_LEVEL} | dict(calls.public_functions(*MODULES))


def wanted(function):
    """The names of the arguments that take numbers, by their annotations."""
    return {
        name
        for name, x in inspect.signature(function).parameters.items()
        if NUMBERS.search(str(x.annotation)) and "Callable" not in str(x.annotation)
    }


def is_numbers(value):
    """Whether an argument is one number, an array, or a list of these."""
    if type(value) in (list, tuple):
        return bool(value) and all(map(is_numbers, value))
    return calls.is_number(value)


def spoiled(value, spoil):
    """An argument whose first array is spoiled."""
    if isinstance(value, list | tuple):
        return [spoiled(value[0], spoil), *value[1:]]
    return spoil(value)


@functools.cache
def call(name):
    """The function of a call and its arguments."""
    if name not in CALLS:
        made = calls.examples()[name]
        return made.func, made.keywords
    given = CALLS[name]
    return FUNCTIONS[name.split()[0]], given() if callable(given) else given


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CALLS, *calls.examples()])
def test_masks_and_units_are_refused_by_the_name_of_the_argument(name):
    function, arguments = call(name)
    for argument in arguments:
        if not is_numbers(arguments[argument]):
            continue
        for kind, (spoil, message) in KINDS.items():
            bad = arguments | {argument: spoiled(arguments[argument], spoil)}
            with pytest.raises(ValueError, match=message) as error:
                function(**bad)
            named = CALLED.get(argument, argument)
            assert re.match(rf"(the )?({argument}|{named})", str(error.value)), (argument, kind, error.value)


def test_every_argument_that_takes_numbers_is_tried():
    tried = {name.split()[0]: set() for name in (*CALLS, *calls.examples())}
    for name in (*CALLS, *calls.examples()):
        arguments = call(name)[1]
        tried[name.split()[0]] |= {key for key, x in arguments.items() if is_numbers(x) or callable(x)}
    for name, function in FUNCTIONS.items():
        if name not in NO_NUMBERS:
            assert wanted(function) <= tried.get(name, set()), name


@pytest.mark.parametrize("part", ["q", "p", "t"])
@pytest.mark.parametrize("kind", KINDS)
def test_masks_and_units_in_a_state_are_refused(part, kind):
    spoil, message = KINDS[kind]
    good = state()._replace(t=jnp.array(0.5))
    bad = good._replace(**{part: spoil(getattr(good, part))})
    many = jax.tree.map(lambda x: np.stack([x, x]), good)
    batch = many._replace(**{part: spoil(getattr(many, part))})
    for states in (bad, batch):
        with pytest.raises(ValueError, match=rf"states?\.{part}.* {message}"):
            li.run(step(), states, 0.1, 2)
    with pytest.raises(ValueError, match=rf"state\.{part}.* {message}"):
        li.integrate(step(), bad, 0.1, 2)


@pytest.mark.parametrize("kind", KINDS)
def test_masks_and_units_are_refused_by_methods(kind, tmp_path):
    spoil, message = KINDS[kind]
    times, attitudes = T[:2], np.stack([Q, Q])
    meta = dict(epoch="2026-01-01 UTC", object="A")
    for call in (
        lambda: run().at(spoil(T[:3])),
        lambda: body().state(angular_velocity=spoil(W)),
        lambda: body().state(attitude=spoil(Q), angular_velocity=W),
        lambda: li.dates.epoch("2026-01-01 UTC").datetimes(spoil(T)),
        lambda: li.files.write_aem(tmp_path / "a.aem", (spoil(times), attitudes), **meta),
        lambda: li.files.write_aem(tmp_path / "a.aem", (times, spoil(attitudes)), **meta),
        lambda: li.files.write_oem(
            tmp_path / "a.oem", kepler_orbit(), times=spoil(times), frame="GCRF", center="EARTH", **meta
        ),
        lambda: systems.rigid_body([spoil(1.0), 2.0, 2.5]),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.long
def test_an_array_without_a_set_mask_and_columns_of_tables_are_numbers():
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    for same in (np.ma.array(J), pandas.Series(J), xarray.DataArray(J)):
        np.testing.assert_array_equal(systems.rigid_body(same).inertia, J)
    for same in (np.ma.array(X), pandas.Series(X), xarray.DataArray(X)):
        assert measure.mean_rate(T, same) == measure.mean_rate(T, X)
    with pytest.raises(ValueError, match="inertia must be plain numbers, got DataArray with the unit 'kg m2'"):
        systems.rigid_body(xarray.DataArray(J, attrs={"units": "kg m2"}))
