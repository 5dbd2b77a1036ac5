"""Published numbers of other codes, recomputed: each case names its source, its inputs and what limits the agreement.

`cases()` lists the cases, `Case.compare()` runs one; the command `lieint check --published` prints all comparisons.
"""

from lieint_jax.app.published import _constant_torque, _detumbling, _free_bodies, _gravity_gradient, _heavy_top, _wheels
from lieint_jax.app.published._case import Case, Comparison

__all__ = ["Case", "Comparison", "cases"]


def cases() -> tuple[Case, ...]:
    """All cases, in the order in which `lieint check --published` prints them."""
    return (
        _gravity_gradient.jeod_gravity_gradient(),
        _gravity_gradient.jeod_pitching(),
        _free_bodies.tumbling_brick,
        _free_bodies.basilisk_free_body(),
        _free_bodies.basilisk_momentum_frame(),
        _wheels.basilisk_wheels,
        _constant_torque.basilisk_constant_torque,
        _detumbling.magnetic_detumbling,
        _heavy_top.multibody_heavy_top,
        _free_bodies.kynema_precession,
    )
