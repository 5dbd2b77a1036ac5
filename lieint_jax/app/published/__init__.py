"""Published numbers of other codes, recomputed: each case names its source, its inputs and what limits the agreement.

`cases()` lists the cases, `Case.compare()` runs one; the command `lieint check --published` prints all comparisons. The
numbers are in `numbers.toml`.
"""

from lieint_jax.app.published._algorithm_903 import algorithm_903_free, algorithm_903_top
from lieint_jax.app.published._case import Case, Comparison, numbers
from lieint_jax.app.published._constant_torque import basilisk_constant_torque
from lieint_jax.app.published._detumbling import magnetic_detumbling
from lieint_jax.app.published._free_bodies import (
    basilisk_free_body,
    basilisk_momentum_frame,
    kynema_precession,
    tumbling_brick,
    van_zon_schofield,
)
from lieint_jax.app.published._gravity_gradient import jeod_gravity_gradient, jeod_pitching
from lieint_jax.app.published._heavy_top import exudyn_heavy_top, kynema_heavy_top
from lieint_jax.app.published._wheels import basilisk_wheels

__all__ = ["Case", "Comparison", "cases", "numbers"]


def cases() -> tuple[Case, ...]:
    """All cases, in the order in which `lieint check --published` prints them."""
    return (
        jeod_gravity_gradient(),
        jeod_pitching(),
        tumbling_brick(),
        algorithm_903_free(),
        van_zon_schofield(),
        algorithm_903_top(),
        basilisk_free_body(),
        basilisk_momentum_frame(),
        basilisk_wheels(),
        basilisk_constant_torque(),
        magnetic_detumbling(),
        kynema_heavy_top(),
        exudyn_heavy_top(),
        kynema_precession(),
    )
