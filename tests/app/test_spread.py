"""`[spread]` of the numbers of a scenario: which there are, how members are drawn, that each is a system of its own."""

from pathlib import Path

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenario_runs import run

import lieint_jax as li
from lieint_jax import measure
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import _spread, water
from lieint_jax.runs import store as archives

pytestmark = pytest.mark.long

KINDS = data_files.table("spreads")  # of a scenario of each kind, the paths of all numbers that can be spread
UNCERTAIN = {key: value for key, value in KINDS.items() if key != "water"}  # whose members are systems of their own


def nested(spread):
    """A table of dotted keys as TOML would nest it."""
    table = {}
    for key, value in spread.items():
        *above, last = key.split(".")
        inner = table
        for part in above:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return table


def load(name, spread, **changes):
    """A shipped scenario without its own spreads and with those of some numbers."""
    return scenarios.parse(bare(name) | {"spread": nested(spread)} | changes, name)


LEFT_OUT = ("spread", "lag_spread", "published", "observation")


def bare(name):
    """The keys of a shipped scenario without any spread."""

    def cleared(tree):
        if isinstance(tree, dict):
            return {key: cleared(x) for key, x in tree.items() if key not in LEFT_OUT}
        return [cleared(x) for x in tree] if isinstance(tree, list) else tree

    return cleared(scenarios.table(name))


def possible(scenario):
    """The numbers of a scenario that can be spread, as its error message lists them."""
    with pytest.raises(ValueError, match="these can be spread") as found:
        scenarios.parse(scenario | {"spread": {"nothing_of_this_name": 1.0}}, "it")
    return str(found.value).partition("these can be spread: ")[2].removesuffix(" (got").split(", ")


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_every_number_of_a_scenario_can_be_spread(name):
    found = possible(bare(name))
    assert set(KINDS[name]) <= set(found)
    declared = set(type(load(name, {}).spread).model_fields)
    assert set(found) == set(KINDS[name]) | declared


def second_moments(J):
    return J.sum(axis=-1, keepdims=True) / 2 - J


@pytest.mark.quick
def test_draws_have_the_given_mean_and_deviation():
    """4000 members: the mean is uncertain by 1/√4000 of the deviation, the deviation by 1.1 %."""
    spread = {"inertia_percent": 2.0, "state.angular_velocity_deg": [0.1, 0.2, 0.3]}
    own = _spread.draw_members(load("toutatis", spread, members=4001))
    J, Omega = own[("inertia",)], own[("state", "angular_velocity_deg")]
    nominal = load("toutatis", {})
    x = np.log(second_moments(J) / second_moments(J[0]))[1:] / 0.02
    y = (Omega[1:] - Omega[0]) / [0.1, 0.2, 0.3]
    np.testing.assert_array_equal(J[0], nominal.inertia)
    np.testing.assert_array_equal(Omega[0], nominal.state.angular_velocity_deg)
    for z in (x, y):
        assert abs(z.mean(axis=0)).max() < 4 / np.sqrt(4000)
        np.testing.assert_allclose(z.std(axis=0), 1, rtol=0, atol=4 / np.sqrt(8000))
    assert abs(np.corrcoef(np.concatenate([x, y], axis=1).T) - np.eye(6)).max() < 4 / np.sqrt(4000)


def test_a_member_is_the_same_in_ensembles_of_every_size_and_with_other_spreads():
    many = _spread.draw_members(load("toutatis", {"inertia": 0.01}, members=50))
    few = _spread.draw_members(load("toutatis", {"inertia": 0.01, "state.euler_313_deg": 1.0}, members=7))
    np.testing.assert_array_equal(many[("inertia",)][:7], few[("inertia",)])
    other = _spread.draw_members(load("toutatis", {"inertia": 0.01}, members=7, seed=2))
    assert (other[("inertia",)][1:] != few[("inertia",)][1:]).all()


def test_every_draw_belongs_to_a_body_an_orbit_a_direction():
    """However wide the spread: draws that no file could have are drawn again."""
    own = _spread.draw_members(load("driven", {"inertia": 1.0, "orbit.eccentricity": 0.5}, members=2000))
    J, e = own[("inertia",)], own[("orbit", "eccentricity")]
    assert (J > 0).all()
    assert (J.max(axis=1) <= J.sum(axis=1) / 2 * (1 + 1e-12)).all()
    assert ((e >= 0) & (e < 1)).all()
    assert e.std() > 0.2
    tensor = [[3.0, 0.4, 0.0], [0.4, 2.5, 0.2], [0.0, 0.2, 2.0]]
    J = _spread.draw_members(load("heavy_top", {"inertia": 0.5}, inertia=tensor, members=500))[("inertia",)]
    moments = np.linalg.eigvalsh(J)
    assert (moments > 0).all()
    assert (moments[:, 2] <= moments.sum(axis=1) / 2 * (1 + 1e-12)).all()
    axes = _spread.draw_members(load("pendulum", {"axis": 0.3}, members=500))[("axis",)]
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1, rtol=0, atol=1e-15)


@pytest.mark.quick
def test_a_spread_that_leaves_members_without_a_value_is_refused():
    scenario = load("driven", {"orbit.eccentricity": 1e6}, members=50)
    with pytest.raises(ValueError, match=r"spread\.orbit\.eccentricity: \d+ of 50 members found no value"):
        _spread.draw_members(scenario)


@pytest.mark.quick
def test_a_spread_of_zero_changes_nothing():
    scenario = load("toutatis", {"inertia": 0.0})
    assert not scenario.has_own_steps()
    assert load("toutatis", {"inertia": 0.1}).has_own_steps()


def test_a_member_with_an_inertia_of_its_own_is_that_body_alone():
    """Observed: 5e-16 after 200 steps, where it differs from the nominal body by 1e-2."""
    scenario = load("toutatis", {"inertia_percent": 1.0}, members=3, steps=200, save_every=200)
    J = _spread.draw_members(scenario)[("inertia",)]
    made = run(scenario)
    for m in (1, 2):
        body = li.systems.rigid_body(J[m])
        start = body.state(scenario.state.attitude(), angular_velocity=scenario.state.rate())
        alone = li.integrate(li.schemes.so3_midpoint(body), start, scenario.dt, 200).state
        np.testing.assert_allclose(made.state.q[-1, m], alone.q[-1], rtol=0, atol=1e-13)
        np.testing.assert_allclose(made.state.p[-1, m], alone.p[-1], rtol=0, atol=1e-13 * abs(alone.p).max())
        assert abs(made.state.q[-1, m] - made.state.q[-1, 0]).max() > 1e-4


def written_out(table, own, m):
    """The keys of a scenario with the numbers of a member in their places."""
    table = jax.tree.map(lambda x: x, table)
    for path, values in own.items():
        inner = table
        for part in path[:-1]:
            labels = [row.get("name", str(k)) for k, row in enumerate(inner, 1)] if isinstance(inner, list) else []
            inner = inner[labels.index(part)] if labels else inner[part]
        inner[path[-1]] = values[m].tolist()
    return table


STEPS = 12
SHORT = {"members": 3, "steps": STEPS, "save_every": STEPS}


def with_all_numbers(name):
    """A scenario with a spread of all its numbers, 0.1 % or 1e-3 of those that are 0, and its third member's file."""
    nominal, spread = _spread.numbers(load(name, {})), {}
    for key in KINDS[name]:
        zero = not nominal[tuple(key.split("."))].value.any()
        spread[key if zero else f"{key}_percent"] = 1e-3 if zero else 0.1
    scenario = load(name, spread, **SHORT)
    table = written_out(bare(name), _spread.draw_members(scenario), 2)
    table.pop("steps_per_orbit", None)  # all members have the steps of the nominal one
    alone = scenarios.parse(table | SHORT | {"members": 1, "dt": scenario.dt}, name)
    return scenario, alone


def first(scenario):
    """The step and the state of the first member."""
    step, states = scenario.build()
    step = _spread.nominal_member(step) if scenario.has_own_steps() else step
    return step, jax.tree.map(lambda x: x[0] if jnp.ndim(x) else x, states)


def assert_close(tree, other):
    """To round-off of the largest component of each leaf."""
    for x, y in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12 * abs(np.asarray(y)).max(initial=0))


@pytest.mark.parametrize("name", UNCERTAIN)
def test_a_member_is_the_system_of_a_file_with_its_numbers(name):
    """All numbers of a kind at once; the first member is that of the file without a spread."""
    scenario, alone = with_all_numbers(name)
    step, states = scenario.build()
    made = {m: jax.tree.map(lambda x, m=m: x[m] if jnp.ndim(x) else x, (step, states)) for m in (0, 2)}
    assert_close(made[2], first(alone))
    assert_close(made[0], first(load(name, {}, **SHORT)))


@pytest.mark.parametrize("name", [x for x in UNCERTAIN if x != "cubesat"])  # whose steps need minutes to compile
def test_a_member_moves_as_the_system_of_that_file(name):
    scenario, alone = with_all_numbers(name)
    made = run(scenario)
    step, start = first(alone)
    end = jax.tree.map(lambda x: x[-1], li.integrate(step, start, scenario.dt, STEPS, save_every=STEPS).state)
    assert_close((made.state.q[-1, 2], made.state.p[-1, 2]), (end.q, end.p))
    assert abs(made.state.q[-1, 2] - made.state.q[-1, 0]).max() > 1e-6 * abs(end.q).max()


def test_droplets_have_temperatures_of_their_own():
    settling = {"temperature_kelvin": 250.0, "steps": 20}
    scenario = load("water", {"settling.temperature_kelvin": 20.0}, members=4, molecules=3, settling=settling)
    step, states = scenario.build()
    assert not scenario.has_own_steps()
    found = jax.vmap(lambda z: water.temperature(step.system, z))(states)
    np.testing.assert_allclose(found, _spread.draw_members(scenario)[("settling", "temperature_kelvin")], rtol=1e-12)


def test_a_report_measures_every_member_in_its_own_system():
    """What is measured of members together is what is measured of each alone, and its spread is that of the weights."""
    scenario = load("heavy_top", {"weight": [0.0, 0.0, 1.0]}, members=4, steps=3000)
    made = run(scenario)
    conserved, rows = scenario.measured(made)
    assert {x.name for x in conserved} == {"energy, relative", "γ·π, relative to |π|", "Π₃, relative to |π|"}
    assert all(x.change().shape == (len(made.t), 4) and x.change().max() < 1e-6 for x in conserved)
    weights = _spread.draw_members(scenario)[("weight",)][:, 2]
    precession = rows[1]
    exact = []
    for m in range(4):
        top = li.systems.heavy_top(scenario.inertia, [0.0, 0.0, weights[m]], scenario.axis)
        z = jax.tree.map(lambda x, m=m: jnp.asarray(x[0, m]), made.state)
        exact.append(float(li.systems.lagrange_motion(top, z).precession_rate))
    np.testing.assert_allclose(precession.values, exact, rtol=1e-5)
    assert np.ptp(exact) > 1e-3 * abs(exact[0])
    assert "closed form" in scenario.report(made)


def test_members_of_uncertain_inertia_scatter_as_the_derivatives_predict():
    """Each of 200 clones, to the square of its deviation: observed 1.2e-5 of the largest displacement at 1e-5."""
    scenario = load("toutatis", {"inertia": 1e-5}, members=200, steps=400, save_every=400)
    own = _spread.draw_members(scenario)[("inertia",)]
    made = run(scenario)

    def body(x):
        P = second_moments(jnp.asarray(scenario.inertia)) * jnp.exp(x)
        return li.systems.rigid_body(P.sum() - P)

    def start(x):
        return body(x).state(scenario.state.attitude(), angular_velocity=jnp.asarray(scenario.state.rate()))

    found = li.transition(lambda x: li.schemes.so3_midpoint(body(x)), start, scenario.dt, 400, parameters=jnp.zeros(3))
    x = np.log(second_moments(own) / second_moments(own[0]))
    space, ends = body(jnp.zeros(3)).phase_space, jax.tree.map(lambda y: jnp.asarray(y[-1]), made.state)
    moved = np.asarray(jax.vmap(lambda z: space.displacement(found.state, z))(ends))
    predicted = x @ np.asarray(found.by_parameters).T
    assert abs(predicted).max() > 1e-6
    np.testing.assert_allclose(moved, predicted, rtol=0, atol=5e-5 * abs(predicted).max())


def test_the_command_line_draws_and_stores_the_members_own_numbers(lieint):
    text = scenarios.resources.files("lieint_jax.app.scenarios").joinpath("driven.toml").read_text(encoding="utf-8")
    spread = "[spread]\ninertia_percent = 1.0\norbit.eccentricity = 0.001"
    Path("my.toml").write_text(text.replace("[spread]", spread), encoding="utf-8")
    out = lieint("run", "my.toml", "--members", "4", "--steps", "200", "--no-certificate")
    assert "inertia 1 % of the second moments of mass along the body axes, orbit.eccentricity 0.001" in out
    assert "4 of 4 members converged" in out
    again = lieint("plot", "my.npz", "--force")
    assert [line for line in again.splitlines() if "librate" in line] == [
        line for line in out.splitlines() if "librate" in line
    ]
    with np.load("my.npz") as stored:
        scenario = scenarios.from_results(archives.open_archive(Path("my.npz")).metadata["scenario"], "my")
        for name, values in scenarios.members_numbers(scenario).items():
            np.testing.assert_array_equal(stored[f"member.{name}"], values)
        assert stored["member.orbit.eccentricity"].shape == (4,)


def test_every_member_librates_about_the_axis_of_its_own_body():
    scenario = load("driven", {"inertia": 0.05}, members=3, steps=100, save_every=10)
    made = run(scenario)
    each = [measure.is_librating(measure.orbit_angles(made.member(m)).vertical) for m in range(3)]
    assert f"  {sum(map(int, each))} of 3 members librate" in "\n".join(scenario.remarks(made))


@pytest.mark.quick
def test_a_stretched_inertia_is_that_of_a_body():
    """Whatever the factors; against the sum over masses."""
    rng = np.random.default_rng(3)
    x, m, factors = rng.normal(size=(20, 3)), rng.uniform(size=20), np.array([0.1, 3.0, 9.0])

    def inertia(x):
        return sum(k * (y @ y * np.eye(3) - np.outer(y, y)) for k, y in zip(m, x, strict=True))

    found = _spread.stretch_inertia(jnp.asarray(inertia(x)), jnp.asarray(factors))
    np.testing.assert_allclose(found, inertia(x * np.sqrt(factors)), rtol=1e-13)
