"""Units that names of columns state, such as "wx [deg/s]": a table in which they contradict its reader is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping

from lieint_jax import _checks
from lieint_jax._text import Text

_SAME = {"sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "minutes": "min", "hours": "h", "days": "d"}
_SAME |= {"dps": "deg/s", "deg/sec": "deg/s", "rad/sec": "rad/s"}
# units of time, angular velocity, length and speed, with those that no table of a reader has
_UNITS = {
    "s",
    "ms",
    "us",
    "ns",
    "min",
    "h",
    "d",
    "rad/s",
    "mrad/s",
    "urad/s",
    "deg/s",
    "mdeg/s",
    "deg/h",
    "rpm",
    "rev/s",
}
_UNITS |= {"km", "m", "cm", "mm", "au", "km/s", "m/s", "au/d", "km/d"}


def check_stated_units(text: Text, line: int, names: list[str], factor: float, known: Mapping[str, float]) -> None:
    """ValueError if a name of a column states, in brackets at its end, another unit than the one that is used.

    Args:
        text: the file, and the `line` of the names.
        line: counted from 1, or 0.
        names: of the columns.
        factor: of the unit that is used.
        known: the factors of the units that may be used.
    """
    for name in names:
        found = re.search(r"[\[(]([^\[\]()]*)[\])]$", name.strip())
        unit = found[1].strip().lower().replace("°", "deg").replace("µ", "u").replace("μ", "u") if found else ""
        unit = _SAME.get(unit, unit)
        if unit in _UNITS and abs(known.get(unit, 0.0) / factor - 1) > 1e-9:
            used = next((key for key, value in known.items() if abs(value / factor - 1) < 1e-9), f"{factor:g}")
            text.fail(
                line, f"the column {_checks.printable(name)!r} states its unit, and is read in {used}: give {unit}"
            )
