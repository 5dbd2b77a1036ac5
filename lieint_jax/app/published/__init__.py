"""Published numbers of other codes, recomputed: each case names its source, its inputs and what limits the agreement.

`cases()` lists the cases, `Case.compare()` runs one; the command `lieint check --published` prints all comparisons.
"""

from lieint_jax.app.published import _basilisk, _detumbling, _kynema, _nasa
from lieint_jax.app.published._case import Case, Comparison

__all__ = ["Case", "Comparison", "cases"]


def cases() -> tuple[Case, ...]:
    """All cases, in the order in which `lieint check --published` prints them."""
    return (
        _nasa.jeod_gravity_gradient(),
        _nasa.jeod_pitching(),
        _nasa.tumbling_brick,
        _basilisk.basilisk_free_body(),
        _basilisk.basilisk_momentum_frame(),
        _basilisk.basilisk_wheels,
        _basilisk.basilisk_constant_torque,
        _detumbling.magnetic_detumbling,
        _kynema.multibody_heavy_top,
        _kynema.kynema_precession,
    )
