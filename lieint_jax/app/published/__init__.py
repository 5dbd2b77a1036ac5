"""Published numbers of other codes, recomputed: each case names its source, its inputs and what limits the agreement.

`cases()` lists the cases, `Case.compare()` runs one; the command `lieint check --published` prints all comparisons.
"""

from lieint_jax.app.published._case import Case, Comparison
from lieint_jax.app.published._constant_torque import basilisk_constant_torque
from lieint_jax.app.published._detumbling import magnetic_detumbling
from lieint_jax.app.published._free_bodies import (
    basilisk_free_body,
    basilisk_momentum_frame,
    kynema_precession,
    tumbling_brick,
)
from lieint_jax.app.published._gravity_gradient import jeod_gravity_gradient, jeod_pitching
from lieint_jax.app.published._heavy_top import multibody_heavy_top
from lieint_jax.app.published._wheels import basilisk_wheels

__all__ = ["Case", "Comparison", "cases"]


def cases() -> tuple[Case, ...]:
    """All cases, in the order in which `lieint check --published` prints them."""
    return (
        jeod_gravity_gradient(),
        jeod_pitching(),
        tumbling_brick(),
        basilisk_free_body(),
        basilisk_momentum_frame(),
        basilisk_wheels(),
        basilisk_constant_torque(),
        magnetic_detumbling(),
        multibody_heavy_top(),
        kynema_precession(),
    )
