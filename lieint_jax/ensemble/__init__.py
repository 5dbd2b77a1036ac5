"""Batches of bodies: over devices and processes, with results in memory or on disk, and a report of failures."""

from lieint_jax.ensemble import processes
from lieint_jax.ensemble._job import Summary
from lieint_jax.ensemble._layout import first_devices, want_devices
from lieint_jax.ensemble._loop import compiler_options, energy
from lieint_jax.ensemble._over_members import over_members
from lieint_jax.ensemble._reading import open_run as open  # noqa: A004
from lieint_jax.ensemble._recording import StoreOptions
from lieint_jax.ensemble._run import run

__all__ = [
    "StoreOptions",
    "Summary",
    "compiler_options",
    "energy",
    "first_devices",
    "open",
    "over_members",
    "processes",
    "run",
    "want_devices",
]
