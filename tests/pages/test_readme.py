"""The front door is true: its Python runs, its files exist, its commands are the ones CI runs."""

import re
from pathlib import Path

import jax
from documents import blocks, words

import lieint_jax as li

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_of_the_readme_runs_and_prints_what_it_shows(capsys):
    (_, code), (_, shown) = blocks(README, "python", "text")
    names = {}
    exec(code, names)
    printed = capsys.readouterr().out
    assert len(code.splitlines()) <= 12
    assert [line.split()[0] for line in printed.splitlines()] == [line.split()[0] for line in shown.splitlines()]
    assert words(printed) == words(shown)
    assert float(li.groups.so3.angle(names["later"].q, names["run"].state.q[-1])) < 0.1
    assert jax.config.jax_enable_x64


def test_the_readme_is_short_and_shows_code_early():
    lines = README.splitlines()
    assert len(lines) <= 120
    assert lines.index("```python") < len(lines) / 3


def test_the_table_of_schemes_in_the_readme_says_what_they_declare():
    declared = {entry.name: entry for entry in li.schemes.catalogue()}
    same = {"γ·π": "momentum", "both momenta": "momentum"}
    table = README.partition("## Which scheme?")[2].partition("\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    assert len(rows) == 10
    for _, steps, conserved, orders in rows:
        named = [declared[name] for name in re.findall(r"`(\w+)\(", steps)]
        kinds = {kind.partition(" (")[0] for entry in named for kind in entry.conserves}
        assert {same.get(x, x) for x in re.split(", | or ", conserved)} <= (kinds or {"nothing exactly"})
        assert (
            any(f"{entry.order:g}".replace("inf", "exact") in orders.split(", ") for entry in named)
            or "(8, 6, 4)" in steps
        )


def test_every_link_of_the_readme_has_a_target():
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(links) > 8
    assert not [link for link in links if not (ROOT / link).exists()]


def test_the_readme_has_one_command_to_try_and_one_to_test():
    commands = re.findall(r"^python3 -m venv .*$", README, re.M)
    assert len(commands) == 2
    assert "lieint run toutatis" in commands[0]
    assert "pytest" in commands[1]
