"""A user's own kind of scenario: that of the page runs by the command, and results do not choose what is imported."""

import re
from pathlib import Path

import numpy as np
import pytest
from documents import blocks

from lieint_jax.app import kind, scenarios
from lieint_jax.app.command import cli

PAGE = (Path(__file__).parents[2] / "docs" / "pages" / "howto" / "kind.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the two files of the page, with fewer members and steps."""
    monkeypatch.chdir(tmp_path)
    [(_, code)], [(_, table)] = blocks(PAGE, "python"), blocks(PAGE, "toml")
    Path("top.py").write_text(code, encoding="utf-8")
    small = table.replace("members = 20", "members = 3")
    Path("top.toml").write_text(small, encoding="utf-8")
    return tmp_path


@pytest.mark.long
def test_the_kind_of_the_page_runs_by_the_command(folder, capsys):
    """A fast top sleeps, a slow one falls; both report what the scheme promises."""
    assert cli.main(["run", "top.toml", "--no-certificate"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"momentum, relative +\S+   conserved to round-off", out)
    assert re.search(r"energy, relative +\S+   bounded, not conserved", out)
    assert "a top sleeps if it spins faster than 4 rad/s" in out
    assert "3 of 3 members converged" in out
    assert Path("top-tilt.png").read_bytes().startswith(b"\x89PNG")
    with np.load("top.npz") as stored:
        assert stored["q"].shape == (101, 3, 4)
    assert cli.main(["plot", "top.npz", "--force"]) == 2
    assert "does not choose what is imported: give --kind FILE.py:CLASS" in capsys.readouterr().err
    assert cli.main(["plot", "top.npz", "--force", "--kind", "top.py:SleepingTop"]) == 0
    assert "a top sleeps if it spins faster" in capsys.readouterr().out


def test_a_slow_top_falls_and_a_fast_one_sleeps(folder):
    """At 0.975 and 1.5 of the spin that it needs: 2√(J₁ weight)/J₃ = 4 rad/s."""
    greatest = {}
    for spin in (3.9, 6.0):
        state = {"quaternion": [1.0, 0, 0, 0], "angular_velocity_rad": [0.0, 0.0, spin]}
        scenario = scenarios.load("top.toml", state=state, steps=1000)
        step, states = scenario.build()
        run = kind_run(step, states, scenario)
        greatest[spin] = scenario.quantities(run)[0].values[1:].max()
    assert greatest[6.0] < 1.5
    assert greatest[3.9] > 5


def kind_run(step, states, scenario):
    import lieint_jax as li

    return li.run(step, states, scenario.dt, scenario.steps, save_every=scenario.save_every, progress=False)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        ("top.py:Top", r"system: top\.py has no kind 'Top'; it has SleepingTop"),
        ("tip.py:Top", r"system: there is no file 'tip\.py', neither here nor next to top\.toml"),
        ("top.py", r"system: top\.py has no kind ''; it has SleepingTop"),
        ("tops", r"system: must be 'binary' or .*, or 'FILE\.py:CLASS' \(got 'tops'\)"),
        ("bad.py:Top", r"system: bad\.py fails when it is imported: ZeroDivisionError"),
        ("empty.py:Top", "it has none: a kind is a subclass of lieint_jax.app.kind.Kind"),
    ],
)
def test_a_kind_that_cannot_be_found_is_named(folder, system, message):
    Path("bad.py").write_text("1 / 0", encoding="utf-8")
    Path("empty.py").write_text("", encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        scenarios.load("top.toml", system=system)


def test_keys_of_an_own_kind_are_checked_like_those_of_others(folder):
    with pytest.raises(ValueError, match=r"weight: .*greater than 0"):
        scenarios.load("top.toml", weight=-1.0)
    with pytest.raises(ValueError, match="hight: unknown key; did you mean weight"):
        scenarios.parse(scenarios.table("top.toml") | {"hight": 1.0}, "top.toml")


@pytest.mark.long
def test_only_the_kind_that_runs_is_imported():
    import subprocess
    import sys

    code = "import sys; from lieint_jax.app import scenarios as s; s.load('toutatis'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.rpartition(".")[2] for name in done.stdout.split() if "app.scenarios." in name}
    assert {name for name in loaded if not name.startswith("_")} == {"rigid_body"}


def test_the_face_has_what_it_lists():
    assert all(hasattr(kind, name) for name in kind.__all__)
    assert sorted(kind.__all__) == kind.__all__
