"""`lieint run spaghetti`: a rod with loads, what is kept in flight, its keys, and a clamped rod under gravity."""

import re
from pathlib import Path

import numpy as np
import pytest
from scenario_runs import run

from lieint_jax.app import scenarios


def small(**changes):
    """The shipped rod with four elements, one member and larger steps."""
    return scenarios.load(
        "spaghetti", **{"elements": 4, "members": 1, "dt": 0.05, "steps": 120, "spread": {}} | changes
    )


def test_a_thrown_rod_has_the_impulse_of_its_loads_and_keeps_its_momenta_in_flight():
    """Observed 3e-15 of energy and momenta, and the impulse to 1e-14."""
    scenario = small()
    path = run(scenario)
    np.testing.assert_allclose(path.state.q[0, 0, -1, :3], [6, 0, 0], rtol=0, atol=1e-14)
    assert path.info.converged.all()
    changes = {x.name: float(x.change().max()) for x in scenario.conserved(path)}
    assert list(changes) == [f"{x}, relative" for x in ("energy less work", "P in free flight", "L in free flight")]
    assert max(changes.values()) < 2e-14
    rows = {x.name: x for x in scenario.quantities(path)}
    impulse = rows["|P| at the end; impulse of the loads"]
    assert impulse.closed_form == 50
    assert impulse.nominal == pytest.approx(50, abs=1e-13)
    assert rows["work of loads and damping"].nominal > 500


@pytest.mark.long
def test_a_clamped_rod_under_gravity_reports_its_energy_alone():
    scenario = small(loads=[], ends=["clamped", "free"], gravity=[0.0, 0.0, -0.5])
    path = run(scenario)
    [energy] = scenario.conserved(path)
    assert energy.name == "energy, relative"
    assert energy.change().max() < 2e-14
    assert [x.name for x in scenario.quantities(path)] == ["largest turn of an element (°)"]


@pytest.mark.long
def test_spaghetti_runs_from_the_command_line(lieint):
    out = lieint("run", "spaghetti", "--members", "3")
    assert "3 of 3 members converged" in out
    found = re.findall(r"^  (?:energy less work|[PL] in free flight), relative +(\S+)   \w", out, re.M)
    assert len(found) == 3
    assert max(map(float, found)) < 2e-14  # 4.7e-15
    lieint.drew("spaghetti-shape.png", "spaghetti-energy.png")
    assert "times as large" not in lieint("animate", "spaghetti.npz", "--seconds", "0.2")
    assert Path("spaghetti.gif").read_bytes().startswith(b"GIF")
