"""What a run shows: periods, tilts, librations, orbits, spectra and light, as functions of a `li.Run`.

| | |
|---|---|
| `tilt`, `pole`, `rotation_rates` | the angle of a body axis; the direction of the angular momentum; the spin |
| `tumbling_periods` | the two mean periods of a tumbling body |
| `nutation` | nutation and precession of a top or a pendulum |
| `orbit_angles`, `orbit_axes` | how a body on a given orbit points |
| `relative_motion` | the motion of one of several bodies about another |
| `distances`, `pair_density` | the distances of all pairs, and how often each occurs |
| `apsides`, `librations` | mean orbit and precession of its apsides; forced and free libration |
| `pair_energies` | how two bodies exchange energy |
| `light_curve`, `brightness`, `lambert` | the light that a convex body of facets reflects (`shapes.facets`) |
| `glossy_brightness` | the same of facets with a lobe, with all derivatives |
| `light_changes`, `light_differences` | other spin states that have the same light, and how much they differ |
| `is_light_symmetry`, `classify_light` | whether a rotation leaves the light unchanged; which of them a fit has found |
| `spectrum`, `line`, `complex_rates` | frequencies, amplitudes and growth at even times |
| `periodogram` | periods at uneven times, with false-alarm probabilities |
| `sines`, `double_periods` | the sines of such a series one by one; the two frequencies of a tumbler's light |
| `combinations`, `combination`, `chance_of_match`, `equivalent_pairs` | of two frequencies, and what they generate |
| `mean_rate`, `unwrapped` | of an angle |
| `is_librating`, `captured_since`, `first_below` | whether, and since when, a series stays within a bound |

Angles are in radians, times in the run's unit. A run of one body gives scalars and series (times,), a batch (members,)
and (times, members), also where each member has its own step. What a run does not show is NaN.
"""

from lieint_jax.measure._attitude import pole, rotation_rates, tilt, tumbling_periods
from lieint_jax.measure._combinations import (
    chance_of_match,
    combination,
    combinations,
    double_periods,
    equivalent_pairs,
    sines,
)
from lieint_jax.measure._distances import distances, pair_density
from lieint_jax.measure._equal_light import (
    SPACE_CHANGES,
    SpinStates,
    classify_light,
    is_light_symmetry,
    light_changes,
    light_differences,
)
from lieint_jax.measure._light import SUN_RADIUS, brightness, glossy_brightness, lambert, light_curve
from lieint_jax.measure._nutation import nutation
from lieint_jax.measure._orbit import orbit_angles, orbit_axes
from lieint_jax.measure._relative_motion import RelativeMotion, apsides, librations, pair_energies, relative_motion
from lieint_jax.measure._series import captured_since, first_below, is_librating, mean_rate, unwrapped
from lieint_jax.measure._spectrum import complex_rates, line, periodogram, spectrum

__all__ = [
    "SPACE_CHANGES",
    "SUN_RADIUS",
    "RelativeMotion",
    "SpinStates",
    "apsides",
    "brightness",
    "captured_since",
    "chance_of_match",
    "classify_light",
    "combination",
    "combinations",
    "complex_rates",
    "distances",
    "double_periods",
    "equivalent_pairs",
    "first_below",
    "glossy_brightness",
    "is_librating",
    "is_light_symmetry",
    "lambert",
    "librations",
    "light_changes",
    "light_curve",
    "light_differences",
    "line",
    "mean_rate",
    "nutation",
    "orbit_angles",
    "orbit_axes",
    "pair_density",
    "pair_energies",
    "periodogram",
    "pole",
    "relative_motion",
    "rotation_rates",
    "sines",
    "spectrum",
    "tilt",
    "tumbling_periods",
    "unwrapped",
]
__dir__ = __all__.copy
