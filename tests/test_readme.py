"""The front door is true: its Python runs, its files exist, its commands are the ones CI runs."""

import re
from pathlib import Path

import jax
import numpy as np
from documents import blocks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_of_the_readme_runs(capsys):
    (_, first), (_, second) = blocks(README, "python")
    names = {}
    exec(first, names)
    assert "exact to round-off" in capsys.readouterr().out
    exec(second.replace("num_steps=100_000", "num_steps=100"), names)
    assert len(names["velocities"]) == 1000
    assert names["defect"] < 2e-15
    assert names["ends"].info.converged.all()
    assert np.isfinite(names["slope"]).all()
    assert jax.config.jax_enable_x64


def test_every_link_of_the_readme_leads_somewhere():
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(links) > 8
    assert not [link for link in links if not (ROOT / link).exists()]


def test_the_two_commands():
    commands = re.findall(r"^python3 -m venv .*$", README, re.M)
    assert len(commands) == 2
    assert "lieint run toutatis" in commands[0]
    assert "pytest" in commands[1]
