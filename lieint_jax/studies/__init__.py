"""Derivatives of whole trajectories, fits, and studies built of them."""

from lieint_jax.studies._reversible import observe, reversible, round_trip_error

__all__ = ["observe", "reversible", "round_trip_error"]
