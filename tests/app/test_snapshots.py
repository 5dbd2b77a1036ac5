"""The reports of all shipped scenarios and studies are those of `tests/data/snapshots`.

Words are the same, numbers to a millionth. One that is meant to change is written again by `tests/lib/snapshots.py`,
and its change is read.
"""

import pytest
import snapshots

LONG = [pytest.param(name, marks=pytest.mark.long) for name in snapshots.commands() if name not in ("list", "schema")]


@pytest.mark.parametrize("command", ["list", "schema", *LONG])
def test_a_command_prints_what_it_printed(command):
    assert snapshots.difference(snapshots.text(command), snapshots.path(command).read_text(encoding="utf-8")) == ""


def test_every_snapshot_is_of_a_command():
    assert {path.stem for path in snapshots.FOLDER.iterdir()} == set(snapshots.commands())


@pytest.mark.parametrize(
    ("found", "same"),
    [
        ("period (d)   5.4124 ± 0.0123", True),
        ("period (d)   5.4125 ± 0.0123", True),  # the last digit, by rounding
        ("period (d)   5.4127 ± 0.0123", False),
        ("period (d)   5.4124 ± 0.0123 days", False),
        ("rate (d)   5.4124 ± 0.0123", False),
        ("period (d)   5.4124 ± 0.0123\nmore", False),
    ],
)
def test_numbers_are_compared_as_printed_and_words_exactly(found, same):
    assert (snapshots.difference(found, "period (d)  5.4124 ± 0.0123") == "") == same
    assert snapshots.difference("energy 1.3e-14 at 12345678.9", "energy -4.2e-16 at 12345688.9") == ""
    assert snapshots.difference("energy 1.3e-14 at 12345678.9", "energy -4.2e-16 at 12345778.9")
    assert snapshots.difference("error 2.1e-07", "error 1.3e-07")
