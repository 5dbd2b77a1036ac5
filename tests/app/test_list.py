"""`lieint list`: every scenario and study is on it, with its cost; long commands print their expected time."""

import pytest

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import list as listing
from lieint_jax.app.command import study
from lieint_jax.app.command.list import Cost


@pytest.mark.long
def test_the_list_describes_every_scenario_and_study(lieint):
    shown = lieint("list")
    for name in scenarios.scenario_names():
        scenario = scenarios.load(name)
        assert scenario.about, f"{name}.toml lacks the line `about`"
        assert f"  {name:<20}{scenario.title}: {scenario.about}\n" in shown
    assert all(f"\n  {name} " in shown for name in study.studies_by_name())
    assert max(map(len, shown.splitlines())) <= 140


def test_the_list_of_a_catalogue_is_the_catalogue(lieint):
    for name, catalogue in (("schemes", li.schemes.catalogue()), ("systems", li.systems.catalogue())):
        shown = lieint("list", name)
        assert shown == f"{catalogue!r}\n"
        assert [line.split()[0] for line in shown.splitlines()[1:]] == [entry.name for entry in catalogue]
    assert tuple(listing.CATALOGUES) == ("schemes", "systems")


def test_the_list_of_a_scenario_is_its_file(lieint, tmp_path):
    (tmp_path / "my.toml").write_text(lieint("list", "toutatis"), encoding="utf-8")
    assert scenarios.table(str(tmp_path / "my.toml")) == scenarios.table("toutatis")
    assert "there is no scenario 'tuotatis': did you mean toutatis?" in lieint.refuse("list", "tuotatis")


@pytest.mark.long
def test_the_list_has_every_measured_cost_and_marks_the_others():
    """`python benchmarks/commands.py --only "run NAME"` times a command."""
    every = {f"run {name}" for name in scenarios.scenario_names()} | {
        f"study {name}" for name in study.studies_by_name()
    }
    timed = {name for name in listing.costs() if name.split()[0] in ("run", "study")}
    assert timed <= every
    assert len(timed) > len(every) / 2
    assert listing.text().count("not measured") == len(every - timed)
    assert all(0 < cost.again <= 2 * cost.first for cost in listing.costs().values())


def test_only_long_commands_print_their_expected_time(monkeypatch, capsys):
    costs = {"run slow": Cost(150.0, 20.0, 1.0, 1.0), "run quick": Cost(5.0, 1.0, 1.0, 1.0)}
    monkeypatch.setattr(listing, "costs", lambda: costs)
    for name in ("run slow", "run quick", "run my.toml"):
        listing.announce(name)
    assert capsys.readouterr().out == "expected time on two cores: 2.5 min, and 20 s from the second run on\n"
