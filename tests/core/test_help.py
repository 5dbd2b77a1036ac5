"""`help` of a room lists what is in it: whoever adds a scheme or a system finds here that the list lacks it."""

import pydoc
import re
import sys

import pytest

import lieint_jax as li

ROOMS = (li, li.schemes, li.systems, li.groups, li.diagnostics, li.fitting, li.measure, li.potentials)
_ELSEWHERE = {  # helpers for writing a potential or a system by users, described by themselves
    "along_R", "at_time", "catalogue", "compiler_options", "count", "covariance", "domain", "energy", "first_devices",
    "given_poses", "invariant_form", "is_chain", "is_driven", "processes", "pytree", "static", "student_t_curvature",
    "student_t_noise_error", "student_t_weights", "torques", "want_devices",
}  # fmt: skip


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_help_begins_with_a_list_of_what_is_there_in_a_screen(room):
    text = room.__doc__
    named = set(re.findall(r"[a-z_]\w*", " ".join(re.findall(r"`([^`]*)`", text))))
    functions = {name for name in room.__all__ if name[0].islower()}
    others = _ELSEWHERE - {"torques"} if room is li else _ELSEWHERE
    assert functions - others <= named
    assert len(text.splitlines()) <= 45
    assert text.splitlines()[0] in pydoc.plain(pydoc.render_doc(room)).splitlines()[3]


@pytest.mark.parametrize("topic", [li, *(getattr(li, name) for name in ("State", "StepInfo", "Trajectory", "Event"))])
def test_help_shows_no_methods_of_tuples(topic):
    """They were 100 lines for each of four classes, half of `help(li)`."""
    text = pydoc.plain(pydoc.render_doc(topic))
    assert "__add__" not in text
    assert "__getitem__" not in text
    assert "_replace" in text
    most = 1570 if sys.version_info < (3, 13) else 1750  # pydoc of 3.13 gives each argument of a long call a line
    assert len(text.splitlines()) <= most  # observed: 1522, and 1700; methods of tuples would be 100 more each


def test_the_list_of_schemes_names_no_other():
    rows = [line.split("|")[1] for line in li.schemes.__doc__.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == {
        name for name in li.schemes.__all__ if name[0].islower() and name != "catalogue"
    }
