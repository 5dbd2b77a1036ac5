"""`lieint list`: every example is on it, with its cost; long commands print their expected time."""

import importlib
import inspect

import pytest

import lieint_jax as li
from lieint_jax.command import listing, scripts
from lieint_jax.command.listing import Cost


def test_the_list_describes_every_example(lieint):
    shown = lieint("list")
    for name in scripts.names():
        title = importlib.import_module(f"lieint_jax.examples.{name}").__doc__.splitlines()[0]
        assert f"  {name:<20}{title}\n" in shown
    assert "200 × 10000; " in shown  # members and steps of the heavy top
    assert max(map(len, shown.splitlines())) <= 140


def test_the_list_of_a_catalogue_is_the_catalogue(lieint):
    for name, catalogue in (("schemes", li.schemes.catalogue()), ("systems", li.systems.catalogue())):
        shown = lieint("list", name)
        assert shown == f"{catalogue!r}\n"
        assert [line.split()[0] for line in shown.splitlines()[1:]] == [entry.name for entry in catalogue]
    assert tuple(listing.CATALOGUES) == ("schemes", "systems")


def test_the_list_of_an_example_is_its_script(lieint):
    assert lieint("list", "toutatis").rstrip() == inspect.getsource(scripts.example("toutatis")).rstrip()
    assert "there is no example 'tuotatis': did you mean toutatis?" in lieint.refuse("list", "tuotatis")


def test_the_list_has_every_measured_cost_and_marks_the_others():
    """`python benchmarks/commands.py --only "run NAME"` times a command."""
    every = {f"run {name}" for name in scripts.names()}
    timed = {name for name in listing.costs() if name.startswith("run ")}
    assert timed <= every
    assert len(timed) > len(every) / 2
    assert listing.text().count("not measured") == len(every - timed)
    assert all(0 < cost.again <= 2 * cost.first for cost in listing.costs().values())


def test_only_long_commands_print_their_expected_time(monkeypatch, capsys):
    costs = {"run slow": Cost(150.0, 20.0, 1.0, 1.0), "run quick": Cost(5.0, 1.0, 1.0, 1.0)}
    monkeypatch.setattr(listing, "costs", lambda: costs)
    for name in ("run slow", "run quick", "run mine"):
        listing.announce(name)
    assert capsys.readouterr().out == "expected time on two cores: 2.5 min, and 20 s from the second run on\n"


@pytest.mark.parametrize("name", scripts.names())
def test_every_example_has_a_title_that_says_what_it_shows(name):
    title, _ = listing.describe(name)
    assert title.endswith(".")
    assert len(title) <= 118
