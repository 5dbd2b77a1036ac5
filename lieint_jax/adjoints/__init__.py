"""Derivatives of whole runs in reverse mode, by undoing steps or by checkpoints."""

from lieint_jax.adjoints._observe import observe
from lieint_jax.adjoints._reversible import reversible, round_trip_error

__all__ = ["observe", "reversible", "round_trip_error"]
