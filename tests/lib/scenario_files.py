"""Files of scenarios for tests of the command line: that of a free body, and any with other lines."""

import re
from pathlib import Path

_BOOK = """
title = "a book"
time_unit = "s"
system = "rigid_body"
inertia = [1.0, 2.0, 3.0]
scheme = "so3_midpoint"
dt = 0.1
steps = 400
save_every = 100
members = 12
seed = 1
[state]
quaternion = [1.0, 0.0, 0.0, 0.0]
angular_velocity_rad = [0.01, 1.0, 0.0]
[spread]
angular_velocity_deg = 5.0
"""


def book(**lines):
    """The text of the file, with these lines in place of those of the keys: book(members="members = 3")."""
    text = _BOOK
    for key, line in lines.items():
        text, found = re.subn(rf"(?m)^{key} = .*$", lambda _, line=line: line, text)
        assert found == 1, key
    return text


def written(name, text, *changes):
    """The name of a file with this text, in which each (old, new) is replaced."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    Path(name).write_text(text, encoding="utf-8")
    return name
