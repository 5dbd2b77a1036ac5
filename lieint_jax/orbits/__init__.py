"""Prescribed orbits, and the environment along them: magnetic field, air, sunlight, and frames for pointing.

| function | gives |
|---|---|
| `kepler`, `from_state` | the Kepler orbit by its elements; through a position and a velocity |
| `hyperbola`, `encounter_speed` | a flyby by its least distance and speed; the speed at which an orbit meets a planet |
| `table` | the orbit through the entries of an ephemeris |
| `secular_j2` | an ellipse about an oblate center, with its secular rates |
| `lvlh` | local vertical, local horizontal along an orbit: the attitude to point to the nadir |
| `earth_field` | the Earth's magnetic field along an orbit, IGRF-14; `vector_table` for other fields |
| `atmosphere` | the density of the air, and the velocity relative to it |
| `sun_direction`, `eclipse` | the direction of the Sun, the part of its light that reaches a satellite |
| `julian_date`, `earth_rotation_angle` | days, and the rotation of the Earth |
| `shared` | any of these, computed once for all members of an ensemble |
| `graded_times` | step times that are short where a flyby is close |

An orbit is any function t ↦ (position, velocity) that JAX can trace. Any consistent units may be used; the Earth's
constants are in km and seconds: `EARTH_GM`, `EARTH_RADIUS`, `EARTH_J2`, `EARTH_RATE`.
"""

from lieint_jax.orbits._air import Air, atmosphere
from lieint_jax.orbits._earth import (
    EARTH_GM,
    EARTH_J2,
    EARTH_RADIUS,
    EARTH_RATE,
    J2000,
    earth_rotation_angle,
    julian_date,
)
from lieint_jax.orbits._frames import LocalFrame, lvlh
from lieint_jax.orbits._from_state import KeplerFromState, from_state
from lieint_jax.orbits._graded_times import graded_times
from lieint_jax.orbits._kepler import Kepler, encounter_speed, hyperbola, kepler
from lieint_jax.orbits._magnetic import EarthField, HarmonicField, earth_field
from lieint_jax.orbits._secular import SecularJ2, secular_j2
from lieint_jax.orbits._shared import SharedFrame, SharedFunction, shared
from lieint_jax.orbits._sun import Eclipse, SunDirection, eclipse, sun_direction
from lieint_jax.orbits._table import Table, VectorTable, table, vector_table

__all__ = [
    "EARTH_GM",
    "EARTH_J2",
    "EARTH_RADIUS",
    "EARTH_RATE",
    "J2000",
    "Air",
    "EarthField",
    "Eclipse",
    "HarmonicField",
    "Kepler",
    "KeplerFromState",
    "LocalFrame",
    "SecularJ2",
    "SharedFrame",
    "SharedFunction",
    "SunDirection",
    "Table",
    "VectorTable",
    "atmosphere",
    "earth_field",
    "earth_rotation_angle",
    "eclipse",
    "encounter_speed",
    "from_state",
    "graded_times",
    "hyperbola",
    "julian_date",
    "kepler",
    "lvlh",
    "secular_j2",
    "shared",
    "sun_direction",
    "table",
    "vector_table",
]
