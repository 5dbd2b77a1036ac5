"""NaN in, NaN out: every public function of a time, an orbit or a field, inside jit.

A comparison, `where`, `clip` or a branch can replace a NaN by a number: sunlight beyond the end of an ephemeris. Each
floating argument in turn is NaN, and every output that it changes must be NaN. What it changes is found by trial. Laws,
potentials and orbits are made by the calls of their `examples()`, which give all arguments.
"""

import inspect

import calls
import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax import attitude, maps, measure, orbits, potentials, shapes, tides, torques
from lieint_jax.core import Law, LawSum, Rotation
from lieint_jax.groups import so3

MODULES = (attitude, orbits, torques, potentials, maps, measure, shapes, tides)
T, Q, OMEGA = 0.7, so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2])), jnp.array([0.5, -0.3, 0.6])
J = jnp.array([1.3, 1.7, 2.2])
TIMES = jnp.linspace(-1.0, 2.0, 5)
ROWS = jnp.sin(jnp.arange(15.0)).reshape(5, 3)
POSITIONS = jnp.array([[0.0, 0.1, 0.2], [4.0, 1.0, -0.5]])
ROTATIONS = jnp.stack([so3.to_matrix(Q), so3.to_matrix(so3.inverse(Q))])
BENT = jnp.stack([so3.to_matrix(so3.multiply(Q, so3.exp(x * jnp.array([0.3, -0.2, 0.4])))) for x in (1.0, 2.0)])
TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def circle(r):
    """An orbit of radius r, as a function of time."""
    return lambda s: (r * jnp.stack([jnp.cos(s), jnp.sin(s), 0 * s]), r * jnp.stack([-jnp.sin(s), jnp.cos(s), 0 * s]))


def rotation_of(t, dt, q, omega):
    """A step of a body."""
    q, h = so3.normalize(q), dt / 2 * omega
    end = so3.normalize(so3.multiply(q, jnp.concatenate([jnp.ones(1), h])))
    return Rotation(t, dt, q, so3.normalize(q + end), end, h, jnp.ones(()), omega, so3.Ad(q, omega))


def of_law(law, rotation):
    """A law's mean torque, its work and its internal state after a step, and what it gives at the start of the step."""
    t, q, omega = rotation.start, rotation.q_n, rotation.Omega
    now = Rotation.at_instant(t, q, omega, rotation.omega)
    inner = 0.1 + jnp.arange(len(law.axes)) / 10 if law.reads else law.start(now)
    held = law.measured(now, inner) if law.held else None
    mean, after = law.mean(rotation, inner)
    found = mean, after, law.work(rotation, mean, inner, after), law.energy(t, q, inner), law.mean(now, inner)[0]
    internal = () if law.key is None else (inner, law.inner_rate(now, inner))
    return found, internal, () if held is None else law.sample(now, rotation.dt, inner, held)[0]


def of_motor(motor, rotation):
    """The torques of motors in a step and at its start."""
    h = 0.1 + jnp.arange(len(motor.axes)) / 10
    return motor.mean(rotation, h), motor(rotation.start, rotation.q_n, rotation.Omega, h)


STEP = dict(t=T, dt=0.1, q=Q, omega=OMEGA)
CHAINS = {"potentials.rod": BENT, "potentials.held": BENT[:1]}


def evaluated(name, made, point):
    """What a law, a potential or an orbit gives at a point; any other result is one already."""
    if isinstance(made, LawSum):
        return [of_law(law, rotation_of(**point)) for law in made.laws]
    if isinstance(made, Law):
        return of_law(made, rotation_of(**point))
    if isinstance(made, torques.WheelMotor):
        return of_motor(made, rotation_of(**point))
    if isinstance(made, potentials.Potential):
        return made.with_bodies(jnp.array([1.0, 0.7]), jnp.ones((2, 3)))(**point) if "poly" in name else made(**point)
    if callable(made):
        return made(**point), made.angular_velocity(**point) if isinstance(made, orbits.LocalFrame) else ()
    return made


def example_case(name, call):
    """The function of all numbers of a call and of those at which its result is evaluated, and these numbers."""
    given, tree = calls.numbers(call.keywords)
    made = call()
    if isinstance(made, Law | LawSum | torques.WheelMotor):
        point = STEP
    elif isinstance(made, potentials.Potential):
        R = CHAINS.get(name, ROTATIONS)
        point = dict(x=POSITIONS[: len(R)], R=R)
    else:
        point = dict(t=T) if callable(made) else {}

    def function(point, given):
        return evaluated(name, call.func(**calls.with_numbers(tree, given)), point)

    return function, dict(point=point, given=given)


MASSES, RADII, THETA = jnp.array([2.0, 1.0]), jnp.array([0.4, 0.2]), jnp.array([0.3, -0.5, 0.7])
SUN = jnp.array([0.6, 0.8, 0.0])
CORNERS = jnp.array([[0.0, 0.1, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.2]])
CASES = {
    **{f"attitude.{name}": (getattr(attitude, name), dict(q=Q)) for name in attitude.__all__ if name != "to_euler"},
    "attitude.to_euler": (lambda q: attitude.to_euler("ZYX", q), dict(q=Q)),
    "attitude.from_euler": (lambda angles: attitude.from_euler("zxz", angles), dict(angles=THETA)),
    "attitude.from_matrix": (attitude.from_matrix, dict(R=ROTATIONS[0])),
    "attitude.from_mrp": (attitude.from_mrp, dict(sigma=THETA)),
    "attitude.from_rotvec": (attitude.from_rotvec, dict(rotvec=THETA)),
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
EXAMPLES = {name: call for name, call in calls.examples().items() if name.split()[0] not in NO_NUMBERS}


def public_functions():
    kappas = {f"maps.{name}": getattr(maps, name) for name in maps.__all__ if name.startswith("kappa_")}
    return dict(calls.public_functions(*MODULES)) | kappas


def test_every_public_function_is_listed():
    assert {name.split()[0] for name in (*CASES, *EXAMPLES)} | set(NO_NUMBERS) == set(public_functions())
    assert not {name.split()[0] for name in EXAMPLES} & set(NO_NUMBERS)


def test_examples_give_all_arguments():
    """By their names, so that a new argument of a law, a potential or an orbit is one that NaN is put into."""
    for name, function in calls.public_functions(*calls.ROOMS):
        given = [set(call.keywords) for other, call in calls.examples().items() if other.split()[0] == name]
        assert set(inspect.signature(function).parameters) == set().union(*given) or not given, name


def changed(x, index):
    """x with other numbers at an index, the last of which is NaN."""
    return [x.at[index].set(x[index] * f + (f - 1) / 10) for f in (0.2, 1.7, -1.0, jnp.nan)]


@pytest.mark.long
@pytest.mark.parametrize("name", [*CASES, *EXAMPLES])
def test_nan_in_nan_out(name):
    function, given = CASES[name] if name in CASES else example_case(name, EXAMPLES[name])
    given = jax.tree.map(lambda x: jnp.asarray(x, float), given)
    leaves, structure = jax.tree.flatten(given)
    places = [(k, index) for k, x in enumerate(leaves) for index in np.ndindex(x.shape)]
    tried = [[*leaves[:k], x, *leaves[k + 1 :]] for k, index in places for x in changed(leaves[k], index)]
    stacked = structure.unflatten([jnp.stack(x) for x in zip(leaves, *tried, strict=True)])

    @jax.jit
    @jax.vmap
    def outputs(arguments):
        found = [x for x in map(jnp.asarray, jax.tree.leaves(function(**arguments))) if x.dtype.kind == "f"]
        return jnp.concatenate([jnp.ravel(x) for x in found])

    first, *rest = np.asarray(outputs(stacked))
    assert np.isfinite(first).all()
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(given)]
    for (k, index), found in zip(places, np.reshape(rest, (len(places), 4, -1)), strict=True):
        depends = (found[:3] != first).any(axis=0)
        assert np.isnan(found[3][depends]).all(), f"NaN at {names[k]}{list(index)}: {first}, {found}"
