"""The examples heavy top and pendulum show their closed forms; their members are spread as they say."""

import re

import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after
from scipy.spatial.transform import Rotation

from lieint_jax.examples import heavy_top, pendulum

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("example", "rows"),
    [
        (
            heavy_top,
            ["nutation period (s)", "mean precession (rad/s)", "least inclination (°)", "greatest inclination (°)"],
        ),
        (
            pendulum,
            [
                "lowest point to lowest point (s)",
                "mean rate about γ (rad/s)",
                "least angle from γ (°)",
                "greatest angle from γ (°)",
            ],
        ),
    ],
    ids=["heavy_top", "pendulum"],
)
def test_the_report_shows_the_closed_form(example, rows, tmp_path):
    """By order 6 at dt = 0.01: all to ten digits."""
    text, _ = run_example(example, tmp_path, members=3, steps=2000)
    assert "3 of 3 members converged" in text
    for row in rows:
        nominal, spread, closed, difference = map(float, numbers_after(row, text))
        assert nominal == pytest.approx(closed, rel=1e-9), row  # as printed
        assert abs(difference) < 1e-10  # 8e-12
        assert spread > 1e-4
    conserved = [float(x) for x in re.findall(r" (\S+)   conserved to round-off", text)]
    if example is pendulum:
        assert len(conserved) == 2
        assert max(conserved) < 1e-13  # floor 9e-15


def test_members_of_the_heavy_top_are_the_same_in_ensembles_of_every_size(tmp_path):
    states = []
    for members in (300, 7):
        folder = tmp_path / f"{members}"
        folder.mkdir()
        _, run = run_example(heavy_top, folder, members=members, steps=1000)
        states.append([np.asarray(run.state.q[0]), np.asarray(run.state.p[0])])
    for many, few in zip(*states, strict=True):
        np.testing.assert_array_equal(many[:7], few)
    attitudes = Rotation.from_quat(states[0][0][:, [1, 2, 3, 0]])
    assert np.rad2deg(np.std((attitudes[1:] * attitudes[0].inv()).as_rotvec())) == pytest.approx(1.0, rel=0.1)
