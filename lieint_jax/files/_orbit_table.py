"""An orbit that a file gives: a table with its epoch and its axes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from lieint_jax import _checks, orbits
from lieint_jax._text import Text
from lieint_jax.core import pytree, static
from lieint_jax.dates import Epoch


@pytree
class OrbitTable(orbits.Table):
    """The orbit of a file: `orbit(t)` is the position and the velocity, in km and km/s, t s after the epoch.

    Between two entries it is a cubic, as in `orbits.table`, whatever interpolation the file recommends. JAX holds 7
    digits without `jax_enable_x64`, so that positions near the Earth are then right to 0.5 m.

    Attributes:
        times: the times of the entries in seconds since the epoch, (n,), the first being 0.
        entries: position and velocity of each, in km and km/s, (6n,); also as `positions` and `velocities`, (n, 3).
        epoch: the date of t = 0.
        frame: the axes, as the file calls them, such as "EME2000", "TEME" or "Ecliptic of J2000.0". A reader warns of
            axes that rotate, such as ITRF; `earth_field`, `atmosphere`, `eclipse` and gravity gradients refuse them.
        center: the body at the origin.
        object: the name of what moves.
    """

    epoch: Epoch = static()
    frame: str = static()
    center: str = static()
    object: str = static()


def orbit_table(
    text: Text, epoch: Epoch, times: np.ndarray, states: np.ndarray, facts: Sequence[str], units: bool = False
) -> OrbitTable:
    """The orbit with these entries, positions and velocities as (n, 6) and frame, center and object as `facts`.

    Positions and velocities that disagree by a factor are an error if `units` were given by a person, else a warning.
    """
    if len(times) < 2:
        text.fail(0, "an orbit needs at least two entries, there is one: the file is cut short")
    t, entries = (_checks.real_array("entries", x) for x in (times, states.ravel()))
    if not (np.diff(np.asarray(t)) > 0).all():
        text.fail(0, "its times need float64: call jax.config.update('jax_enable_x64', True) first")
    found = OrbitTable(t, entries, epoch, *facts)
    if _checks.rotates(found.frame):
        axes = f"the axes {_checks.printable(found.frame)} rotate, and so do positions and velocities here"
        remedy = "laws that need inertial axes refuse this orbit; export it in GCRF, EME2000 or TEME"
        warnings.warn(f"{text.name}: {axes}: {remedy}", stacklevel=3)
    found.check_velocities(f"{text.name}: ", refuse=units)
    return found
