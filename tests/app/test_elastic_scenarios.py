"""`lieint run pseudo_rigid` and `lieint run pendulum`: small ensembles, the reports, and bad files."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from scenario_runs import run

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import pseudo_rigid
from lieint_jax.types import State, StepInfo, Trajectory

pytestmark = pytest.mark.long


def still(step, states):
    """A run that has only its initial states."""
    members = len(states.q)
    start = jax.tree.map(lambda x: np.asarray(x)[None], states)
    info = StepInfo(np.zeros((1, members)), np.ones((1, members), bool))
    return li.Run.of(step, Trajectory(np.zeros(1), start, info))


def test_pseudo_rigid_has_the_energy_variation_of_figure_3c_in_its_first_quarter(lieint):
    """The first quarter of Figure 3c's midpoint run already has the variation of its caption."""
    text = (
        scenarios.resources.files("lieint_jax.app.scenarios").joinpath("pseudo_rigid.toml").read_text(encoding="utf-8")
    )
    Path("ball.toml").write_text(text.replace('rule = "average"', 'rule = "symplectic"'), encoding="utf-8")
    out = lieint("run", "ball.toml", "--members", "3", "--steps", "1000")
    assert "3 of 3 members converged" in out
    assert "exact to round-off a step" in out
    assert float(re.search(r"midpoint rule +(\S+)   published 0.0023", out)[1]) == pytest.approx(2.3e-3, rel=0.02)
    assert 1e-4 < float(re.search(r"energy, relative +(\S+)   bounded, not conserved", out)[1]) < 1e-2  # 1.7e-3
    assert float(re.search(r"momentum rot\[PFᵀ\], relative +(\S+)   conserved", out)[1]) < 3e-14
    assert 0.9 < float(re.search(r"least det F +(\S+)   above 0", out)[1]) < 1
    lieint.drew("ball-torus.png", "ball-energy.png")


def test_shipped_pseudo_rigid_has_the_energy_variation_of_figure_3c():
    scenario = scenarios.load("pseudo_rigid", members=8)
    made = run(scenario)
    energy, momentum = scenario.conserved(made)
    assert made.info.converged.all()
    assert [x.promise for x in (energy, momentum)] == ["conserved to round-off"] * 2
    assert energy.change().max() < 2e-13  # floor 3e-14
    assert momentum.change().max() < 1e-13  # floor 1e-14
    series = scenario.energies(made)
    assert series.converged
    assert np.ptp(series.energy[pseudo_rigid.MIDPOINT]) == pytest.approx(2.31e-3, rel=3e-3)
    assert np.ptp(series.energy["the rule 'average'"]) < 5e-12


def test_pseudo_rigid_members_are_spread_about_the_nominal_state():
    """The first is Figure 3c's; the others turn with its velocity and their own spin; the seed decides."""
    scenario = scenarios.load("pseudo_rigid", members=2000)
    step, states = jax.device_get(scenario.build())
    body = step.system
    np.testing.assert_array_equal(states.q[0], np.eye(3))
    momentum = jax.jit(lambda q, p: body.momentum(State(q, p)))(states.q[0], states.p[0])
    np.testing.assert_allclose(momentum, [0, 0, 6], rtol=0, atol=1e-15)
    assert np.std(np.asarray(states.q[1:])) == pytest.approx(np.hypot(0.01, np.sqrt(2) / 3), rel=0.01)
    omega = np.asarray(states.p[1:] / 2 @ np.linalg.inv(states.q[1:]))
    np.testing.assert_allclose(omega, -np.swapaxes(omega, 1, 2), rtol=0, atol=1e-14)  # rotations only
    assert np.std(omega[:, 2, 1]) == pytest.approx(0.05, rel=0.1)
    again = scenarios.load("pseudo_rigid", members=1).build()[1]
    np.testing.assert_array_equal(np.asarray(again.p)[0], states.p[0])
    other = scenarios.load("pseudo_rigid", members=2, seed=1).build()[1]
    assert np.abs(np.asarray(other.q)[1] - states.q[1]).max() > 1e-3


def test_a_nominal_velocity_is_that_of_all_members():
    """A body that stretches: V F₀⁻¹ is theirs too, so without spread they are the nominal one."""
    state = {"deformation": np.diag([1.1, 1.0, 0.9]).tolist(), "velocity": np.diag([0.1, 0.0, -0.2]).tolist()}
    scenario = scenarios.load("pseudo_rigid", members=3, state=state, spread={})
    _, states = scenario.build()
    states = jax.device_get(states)
    for x in states[:2]:
        np.testing.assert_allclose(x, np.broadcast_to(x[0], x.shape), rtol=0, atol=1e-15)
    np.testing.assert_allclose(states.p[0], 2 * np.diag([0.1, 0.0, -0.2]), rtol=0, atol=1e-15)


def test_pendulum_runs_from_the_command_line(lieint):
    out = lieint("run", "pendulum", "--members", "3", "--steps", "1000")
    assert "3 of 3 members converged" in out
    changes = [float(x) for x in re.findall(r" +(\S+)   conserved to round-off$", out, re.M)][:3]
    assert max(changes) < 1e-13  # floor 9e-15
    period = re.search(r"lowest point \(s\) +(\S+) +\S+ +(\S+)", out)
    assert float(period[1]) == float(period[2]) == 1.0608362624
    assert out.count("53.1301023542") == 2  # the greatest angle, and its closed form
    lieint.drew("pendulum-path.png", "pendulum-energy.png")


def test_the_closed_form_of_the_pendulum_has_three_known_limits():
    """Three limits of it, by other formulas.

    A conical pendulum goes round at √(G/cos θ), and its angle swings about θ with the frequency √(G(1 + 3cos²θ)/cos θ);
    a swing in a plane has twice the time from lowest to lowest point, by the arithmetic-geometric mean.
    """
    G, theta = 9.80665, np.arccos(0.6)
    rate = np.sqrt(G / 0.6)
    state = {"direction": [0.8, 0.0, -0.6], "velocity": [0.0, float(0.8 * rate * 1.0001), 0.0]}
    scenario = scenarios.load("pendulum", members=1, state=state)
    step, states = scenario.build()
    rows = scenario.quantities(still(step, states))
    assert rows[1].closed_form == pytest.approx(-rate, rel=1e-3)  # about γ, which points down
    assert rows[0].closed_form == pytest.approx(2 * np.pi / np.sqrt(G * (1 + 3 * 0.36) / 0.6), rel=1e-3)
    assert rows[2].closed_form == pytest.approx(np.rad2deg(theta), abs=0.05)
    state["velocity"] = [0.0, 1e-4, 0.0]
    narrow = scenarios.load("pendulum", members=1, state=state).build()[1]
    x, y = 1.0, np.cos(theta / 2)
    for _ in range(6):
        x, y = (x + y) / 2, np.sqrt(x * y)
    period = scenario.quantities(still(step, narrow))[0].closed_form
    assert period == pytest.approx(np.pi / x / np.sqrt(G), rel=1e-6)


def test_the_pendulum_as_a_top_has_its_energy_and_momentum():
    scenario = scenarios.load("pendulum", members=5, axis=[0.6, 0.0, 0.8], mass=2.0)
    step, states = scenario.build()
    bob = step.system
    top, as_top = jax.vmap(li.systems.pendulum_as_top, (None, 0), (None, 0))(bob, states)

    def measured(system, states):
        return jax.vmap(system.energy)(states), jax.vmap(system.momentum)(states)

    (energies, momenta), Pi, ours = jax.device_get(
        jax.jit(lambda top: (measured(top, as_top), jax.vmap(top.body_momentum)(as_top), measured(bob, states)))(top)
    )
    np.testing.assert_allclose(energies, ours[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(Pi[:, 2], 0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(momenta, -ours[1], rtol=0, atol=1e-14)
