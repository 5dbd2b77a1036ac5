"""What a user's own law of torque needs."""

from lieint_jax.types import Law, Rotation, total

__all__ = ["Law", "Rotation", "total"]
