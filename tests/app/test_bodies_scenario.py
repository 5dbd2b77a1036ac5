"""`lieint run` of the kind `bodies`: its keys, its potentials and schemes, and the triple asteroid 2001 SN263."""

import re
from pathlib import Path
from typing import get_args

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenario_runs import run

import lieint_jax as li
from lieint_jax import orbits, potentials, schemes, systems
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import bodies
from lieint_jax.groups import so3

pytestmark = pytest.mark.long


def body(name, x, **keys):
    """The table of a round body of 2 kg at x on the x axis."""
    given = dict(name=name, mass_kg=2.0, moments_kg_m2=[1.0, 1.0, 1.0], position_m=[x, 0.0, 0.0])
    return given | dict(velocity_m_s=[0.0, 0.0, 0.0], angular_velocity_rad=[0.0, 0.0, 1.0]) | keys


def book(**keys):
    """The table of a scenario of two bodies that attract each other."""
    return data_files.table("scenarios/two_bodies") | keys


SPRING = dict(kind="spring", between=["A", "B"], points_m=[[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]], stiffness_n_m=3.0)
FIELD = dict(kind="uniform_field", field_m_s2=[0.0, 0.0, -9.81])


@pytest.mark.quick
def test_a_quaternion_of_five_digits_is_normalized_with_a_warning():
    q = [0.73674, 0.57997, 0.13156, 0.32176]
    with pytest.warns(RuntimeWarning, match=r"quaternion has the norm 0\.9999.*: normalized"):
        found = scenarios.parse(book(bodies=[body("A", -1.0, quaternion=q), body("B", 2.0)]), "mine.toml")
    np.testing.assert_allclose(found.bodies[0].quaternion, np.array(q) / np.linalg.norm(q), rtol=0, atol=1e-16)
    assert scenarios.parse(found.model_dump(), "mine.npz") == found  # without a warning


@pytest.mark.quick
def test_the_scenario_stored_with_a_run_reads_back():
    given = book(bodies=[body("A", 0.0, quaternion=[0.6, 0.8, 0.0, 0.0]), body("B", 1.0)], potential=[SPRING, FIELD])
    scenario = scenarios.parse(given, "mine.toml")
    assert scenarios.parse(scenario.model_dump(), "mine.npz") == scenario


@pytest.mark.quick
def test_the_schema_has_the_kind_with_its_tables():
    definitions = scenarios.schema()["$defs"]
    (keys,) = (
        x["properties"] for x in definitions.values() if x["properties"].get("system", {}).get("const") == "bodies"
    )
    for name in ("bodies", "potential"):
        assert keys[name]["type"] == "array"
        inner = definitions[keys[name]["items"]["$ref"].rpartition("/")[2]]["properties"]
        assert all("description" in inner[key] for key in inner if key not in ("kind", "spread"))


def test_the_reference_of_the_site_has_the_kind():
    source = Path(__file__).parents[2] / "docs" / "hooks" / "scenario_keys.py"
    pytest.importorskip("mkdocs")
    module = {"__name__": "scenario_keys"}
    exec(compile(source.read_text(encoding="utf-8"), str(source), "exec"), module)
    page = module["_page"]()
    for text in ('## `system = "bodies"`', "### `[[bodies]]`", "### `[[potential]]`", "scenario sn263"):
        assert text in page


def test_a_sum_of_potentials_agrees_with_the_same_bodies_by_the_library():
    """Gravity, a spring and a field, one step: potential, state and step are those of the package, to the bit."""
    three = [
        body("A", -1.0, quaternion=[0.6, 0.8, 0.0, 0.0], moments_kg_m2=[1.0, 2.0, 2.5]),
        body("B", 2.0, velocity_m_s=[0.0, 1.0, 0.0]),
        body("C", 5.0, euler_313_deg=[10.0, 20.0, 30.0], mass_kg=1.0),
    ]
    terms = [dict(kind="point_masses", G=2.0, softening_m=0.5), SPRING | dict(length_m=1.0), FIELD]
    scenario = scenarios.parse(book(bodies=three, potential=terms, scheme="splitting", order=2), "mine.toml")
    made, states = scenario.build()
    step, state = (jax.tree.map(lambda x: x[0], tree) for tree in (made, states))

    m, J = [2.0, 2.0, 1.0], [[1.0, 2.0, 2.5], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    gravity = potentials.point_masses(2.0, m, softening=0.5)
    spring = potentials.springs([[0, 1]], [SPRING["points_m"]], 3.0, 1.0)
    V = gravity + potentials.uniform_field([0.0, 0.0, -9.81], m) + spring
    pair = systems.rigid_bodies(m, J, V)
    turned = jnp.stack(
        [jnp.array([0.6, 0.8, 0, 0]), jnp.eye(4)[0], so3.from_euler_313(jnp.deg2rad(jnp.arange(1, 4) * 10.0))]
    )
    mine = pair.state(
        [[-1.0, 0, 0], [2.0, 0, 0], [5.0, 0, 0]],
        turned,
        velocities=[[0.0, 0, 0], [0, 1.0, 0], [0, 0, 0]],
        angular_velocities=[[0.0, 0, 1.0]] * 3,
    )
    ends = [jax.jit(lambda z, s=s: s(z, 0.1)[0])(z) for s, z in ((step, state), (schemes.splitting(pair), mine))]
    for a, b in zip(jax.tree.leaves(ends[0]), jax.tree.leaves(ends[1]), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-15, atol=2e-15)  # moments by squared semi-axes: observed 9e-16
    kept = step.system.momentum(state)
    assert float(kept[2]) == 0  # P along the field is not conserved


def test_one_body_falls_in_a_field():
    """x = x₀ + vt + gt²/2 after ten steps; the splitting is exact there. Observed 2e-15."""
    only = [body("A", 1.0, velocity_m_s=[0.0, 3.0, 4.0])]
    scenario = scenarios.parse(book(bodies=only, potential=[FIELD], scheme="splitting"), "mine.toml")
    path = run(scenario)
    np.testing.assert_allclose(path.state.q[-1, 0, 0, :3], [1.0, 3.0, 4.0 - 9.81 / 2], rtol=1e-14)
    report = scenario.report(path)
    assert re.search(r"A: rotation period, mean rate \(h\) +0.00174533 ", report)
    assert "P across the field" in report


def as_bodies(pair):
    """The nominal state of a scenario of the kind `binary` as one of the kind `bodies`."""
    step, states = pair.build()
    system, state = (jax.tree.map(lambda x: x[0], tree) for tree in (step.system, states))
    v, Omega = state.p[:, :3] / system.masses[:, None], system.angular_velocities(state)
    tables = [
        dict(
            name=name,
            mass_kg=float(system.masses[i]),
            moments_kg_m2=system.inertias[i].tolist(),
            position_m=state.q[i, :3].tolist(),
            velocity_m_s=v[i].tolist(),
            quaternion=state.q[i, 3:].tolist(),
            angular_velocity_rad=Omega[i].tolist(),
        )
        for i, name in enumerate(("primary", "secondary"))
    ]
    gravity = [dict(kind="maccullagh", G=pair.G)]
    clock = pair.model_dump(include={"dt", "steps", "save_every", "scheme", "order"})
    return scenarios.parse(book(bodies=tables, potential=gravity, **clock), "pair.toml")


def test_two_bodies_move_as_those_of_the_kind_binary():
    """1999 KW4 over 26 d by both kinds, from one state: positions and periods."""
    pair = scenarios.load("kw4", members=1, steps=1248)
    path = run(pair)
    scenario = as_bodies(pair)
    mine = run(scenario)
    apart = np.linalg.norm(mine.state.q[..., :3] - path.state.q[..., :3], axis=-1).max()
    assert apart < 1e-8 * 2548  # round-off of masses and moments, grown along the orbit
    theirs = {x.name: x.nominal for x in pair.quantities(path)}
    ours = {x.name: x.nominal for x in scenario.quantities(mine)}
    for a, b in (
        ("orbital period (h)", "secondary about primary: period (h)"),
        (
            "eccentricity of the mean ellipse",
            "  eccentricity of the mean ellipse",
        ),
        ("precession of the line of apsides (°/d)", "  precession of the line of apsides (°/d)"),
    ):
        assert ours[b] == pytest.approx(theirs[a], rel=1e-7)


@pytest.mark.parametrize("scheme", get_args(bodies.Bodies.model_fields["scheme"].annotation))
def test_every_scheme_can_be_chosen(scheme):
    """A third of an eccentric orbit of two points, by the orders that are the default, against nystrom of order 6."""
    pair = [body("A", -1.0, velocity_m_s=[0.0, -0.6, 0.0]), body("B", 1.0, velocity_m_s=[0.0, 0.6, 0.0])]
    terms = [dict(kind="point_masses", G=1.0)]
    keys = dict(bodies=pair, potential=terms, steps=40, dt=0.05)
    fine = run(scenarios.parse(book(**keys), "mine.toml"))
    path = run(scenarios.parse(book(**keys, scheme=scheme), "mine.toml"))
    assert scheme.split("_")[0] in path.step.name
    assert path.info.converged.all()
    error = 1e-3 if scheme in ("splitting", "bodies_energy_momentum") else 1e-13  # observed 4e-4 and 2e-4, 1e-14
    assert abs(path.state.q[-1] - fine.state.q[-1]).max() < error


def test_members_spread_as_the_file_says_and_the_first_is_the_nominal_one():
    spread = dict(position_m=1e-3, velocity_m_s=1e-2, mass_percent=1.0, attitude_deg=2.0)
    scenario = scenarios.parse(
        book(bodies=[body("A", -1.0, spread=spread), body("B", 2.0)], members=400, barycentric=True), "mine.toml"
    )
    step, states = scenario.build()
    m, x = np.asarray(step.system.masses), np.asarray(states.q)[..., :3]
    v = np.asarray(states.p)[..., :3] / m[..., None]
    assert abs((m[..., None] * x).sum(axis=1)).max() < 1e-14
    np.testing.assert_allclose(x[0, 1] - x[0, 0], [3.0, 0, 0], rtol=1e-15)
    np.testing.assert_array_equal(m[0], [2.0, 2.0])
    assert np.std((x[:, 1] - x[:, 0])[1:], axis=0) == pytest.approx(1e-3, rel=0.15)  # of 400: 1 sigma is 0.035
    assert np.std((v[:, 1] - v[:, 0])[1:], axis=0) == pytest.approx(1e-2, rel=0.15)
    assert np.std(m[1:, 0]) == pytest.approx(0.02, rel=0.15)
    assert np.ptp(m[:, 1]) == 0
    assert "A's mass 1 %" in scenario.assumption()


@pytest.mark.quick
def test_the_states_of_sn263_are_those_of_its_elements():
    """Periods and eccentricities of the file's comments, in Jacobi's coordinates; rounded to mm and 1e-7 m/s."""
    scenario = scenarios.load("sn263")
    alpha, gamma, beta = scenario.bodies
    G, M, day = 6.67430e-11, alpha.mass(), 86400.0

    def position_and_velocity(mu, period, *elements, **angles):
        a = (mu * (period / 2 / np.pi) ** 2) ** (1 / 3)
        return [np.asarray(y) for y in orbits.kepler(mu, a, *elements, **angles)(0.0)]

    inner = position_and_velocity(G * (M + gamma.mass()), 0.686 * day, 0.016)
    outer = position_and_velocity(
        G * (M + gamma.mass() + beta.mass()), 6.225 * day, 0.015, np.deg2rad(14), periapsis=np.pi
    )
    share = gamma.mass() / (M + gamma.mass())
    for found, y in ((gamma, inner), (beta, [b + share * a for a, b in zip(inner, outer, strict=True)])):
        np.testing.assert_allclose(found.position_m, y[0], rtol=0, atol=6e-4)
        np.testing.assert_allclose(found.velocity_m_s, y[1], rtol=0, atol=6e-8)


def test_sn263_conserves_its_invariants_and_has_the_published_precession(lieint):
    out = lieint("run", "sn263", "--members", "2", "--out", "x.npz")
    assert "2 of 2 members converged" in out
    period, apsides = (
        float(re.search(rf"{name} +(\S+)", out)[1]) for name in (r"Gamma about Alpha: period \(h\)", r"apsides \(°/d\)")
    )
    assert period == pytest.approx(16.46, rel=0.01)
    assert apsides == pytest.approx(1.1, abs=0.02)  # the file's oblateness is chosen for it
    for name in ("energy H", "linear momentum P", "angular momentum L"):
        assert float(re.search(rf"  {name}, .* (\S+)$", out, re.M)[1]) < 5e-13  # observed 8e-14 of 50 members
    lieint.drew("x-motion.png")
    assert "Beta about Alpha: period (h)" in lieint("plot", "x.npz", "--force")


def test_sn263_agrees_with_the_same_bodies_by_the_library():
    """Ten steps of the nominal member against li.integrate of bodies made by hand."""
    scenario = scenarios.load("sn263", members=1, steps=10)
    m = np.array([x.mass() for x in scenario.bodies])
    J = m[:, None] * np.array([np.sum(s) - s for s in (np.square(x.semi_axes_m) / 5 for x in scenario.bodies)])
    x, v = (np.array([getattr(b, name) for b in scenario.bodies]) for name in ("position_m", "velocity_m_s"))
    x, v = (y - m @ y / m.sum() for y in (x, v))
    triple = systems.rigid_bodies(m, J, potentials.maccullagh(6.67430e-11, m, J))
    Omega = np.array([b.rate() for b in scenario.bodies])
    state = triple.state(x, velocities=v, angular_velocities=Omega)
    end = jax.jit(lambda z: li.integrate(schemes.nystrom(triple, 6), z, scenario.dt, 10, save_every=10))(state).state
    q = run(scenario).state.q[-1, 0]
    np.testing.assert_allclose(q, end.q[-1], rtol=1e-13, atol=1e-9)  # m; observed 4e-12
