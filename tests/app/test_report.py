"""What kinds of scenario declare, and the report that is printed of it: changes, spreads, columns, notes."""

import re

import numpy as np
import pytest

from lieint_jax.app import scenarios
from lieint_jax.app.scenarios import _report
from lieint_jax.app.scenarios._keys import Published
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runs import length

BOOK = Published(value=2.0, error=0.5, source="a book")


@pytest.mark.parametrize("name", scenarios.kinds())
def test_every_kind_declares_its_keys_states_report_and_pictures(name):
    kind = scenarios.kinds()[name]
    assert issubclass(kind, Kind)
    assert kind.pictures()
    assert all(picture.__doc__ for picture in kind.pictures().values())
    assert {"report", "conserved", "quantities", "remarks"} & set(vars(kind))


def test_a_change_is_relative_to_its_size_and_from_the_initial_value():
    values = np.array([[1.0, 2.0], [1.5, 2.0], [1.0, 1.0]])
    np.testing.assert_array_equal(Conserved("x", values, np.array([0.5, 2.0])).change(), [[0, 0], [1, 0], [0, 0.5]])
    np.testing.assert_array_equal(Conserved("x", values, initial=0.0).change(), values)


def test_the_change_of_a_vector_is_its_largest_component_or_its_length():
    values = np.zeros((2, 1, 3))
    values[1, 0] = [3.0, -4.0, 0.0]
    assert Conserved("x", values).change()[1] == 4
    assert Conserved("x", values, norm=length).change()[1] == 5
    matrices = np.stack([np.zeros((1, 2, 2)), np.full((1, 2, 2), -7.0)])
    assert Conserved("F", matrices).change()[1] == 7


def test_the_spread_is_the_standard_deviation_and_of_angles_that_of_differences():
    assert Quantity("x", np.array([1.0, 2.0, 3.0])).spread == 1
    assert Quantity("x", np.array([1.0])).spread == 0
    assert Quantity("x", np.array([359.0, 0.0, 1.0]), angle=True).spread == 1
    assert np.isnan(Quantity("x", np.array([1.0, np.nan])).spread)


def report(*quantities, conserved=()):
    return _report.text(scenarios.load("toutatis", members=1), conserved, quantities, ["  a remark"])


def test_columns_are_printed_where_there_is_something_to_print():
    plain = report(Quantity("speed (m/s)", np.array([1.25, 1.75]), ".2f"))
    assert re.search(r"^ +nominal  ± ensemble$", plain, re.M)
    assert re.search(r"^  speed \(m/s\) +1.25 +0.35$", plain, re.M)
    assert plain.endswith("\n  a remark")
    exact = report(Quantity("period", np.array([1.0]), closed_form=1.5), Quantity("rate", np.array([np.nan])))
    assert re.search(r"nominal  ± ensemble +closed form +difference$", exact, re.M)
    assert re.search(r"^  period +1.0000000000 +— +1.5000000000 +-5.0e-01$", exact, re.M)
    assert re.search(r"^  rate +— +— +— +—$", exact, re.M)
    cited = report(Quantity("period", np.array([2.25, 2.5]), published=[BOOK, Published(value=3, source="another")]))
    assert re.search(r"^  period +2.2500 +0.1768   2 ± 0.5  \(a book\)\n +3  \(another\)$", cited, re.M)
    assert "!" not in cited


def test_the_largest_change_is_printed_next_to_the_promise():
    values = np.array([[1.0, 1.0], [1.0, 1.5]])
    text = report(conserved=[Conserved("energy", values, promise=_report.ROUND_OFF), Conserved("P", 0 * values)])
    assert re.search(r"^  largest change, all members and saved times +the scheme promises$", text, re.M)
    assert re.search(r"^  energy +5.0e-01   conserved to round-off$", text, re.M)
    assert re.search(r"^  P +0.0e\+00$", text, re.M)


def test_a_value_far_from_the_published_one_is_noted():
    note = " ".join(report(Quantity("period (d)", np.array([-4.0, -4.1]), published=BOOK)).partition("! ")[2].split())
    assert "period (d): The nominal member differs from the published value by -6, 12 times" in note
    assert "and in its sign" in note


def test_the_assumption_names_the_spreads_that_are_not_zero():
    scenario = scenarios.load("toutatis", spread={"attitude_deg": 0.0, "angular_velocity_rad": 0.01})
    assert scenario.assumption().endswith("(1 sigma, each component): angular velocity 0.01 rad/d")
    assert scenarios.load("toutatis", spread={}).assumption().endswith(": none")
    assert scenarios.load("water").assumption().startswith("members: other")


def test_the_spread_of_an_angle_wraps_around_the_circle():
    assert Quantity("longitude", np.array([0.1, 359.9, 0.3]), angle=True).spread == pytest.approx(0.2, rel=3e-13, abs=0)
