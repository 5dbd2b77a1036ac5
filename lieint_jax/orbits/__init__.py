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

from lieint_jax._discover import publish as _publish

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
