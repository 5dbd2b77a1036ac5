"""Runs of one body: many steps, output at given times, events."""

from lieint_jax.integrate._clock import Given, Uniform, at_time, refuse_times
from lieint_jax.integrate._event import Event, event, events
from lieint_jax.integrate._run import from_start, integrate, intervals, prepared, saves, steps

__all__ = [
    "Event",
    "Given",
    "Uniform",
    "at_time",
    "event",
    "events",
    "from_start",
    "integrate",
    "intervals",
    "prepared",
    "refuse_times",
    "saves",
    "steps",
]
