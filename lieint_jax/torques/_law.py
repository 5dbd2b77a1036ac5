"""What a user's own law of torque needs."""

from __future__ import annotations

from functools import partial

from lieint_jax._numerics.arrays import Calls
from lieint_jax.core import Law, Rotation, total
from lieint_jax.torques._damping import Viscous

__all__ = ["Law", "Rotation", "total"]


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"total": partial(total, laws=[Viscous(0.1), Viscous(0.2)])}
