"""Runs of one body: many steps, output at given times, events."""

from lieint_jax._integrate._clock import (
    GridClock,
    StateClock,
    UniformClock,
    at_time,
    clock_of,
    more_times,
    outputs,
    refuse_times,
)
from lieint_jax._integrate._event import Event, event, events
from lieint_jax._integrate._interpolate import interpolate
from lieint_jax._integrate._run import (
    from_start,
    integrate,
    intervals,
    of_any_length,
    prepared,
    rows_for,
    saves,
    steps,
    trajectory,
)

__all__ = [
    "Event",
    "GridClock",
    "StateClock",
    "UniformClock",
    "at_time",
    "clock_of",
    "event",
    "events",
    "from_start",
    "integrate",
    "interpolate",
    "intervals",
    "more_times",
    "of_any_length",
    "outputs",
    "prepared",
    "refuse_times",
    "rows_for",
    "saves",
    "steps",
    "trajectory",
]
