"""Runs of one body: many steps, output at given times, events."""

from lieint_jax._integrate._adjoint import Adjoint
from lieint_jax._integrate._clock import (
    MOST_TO_OUTPUTS,
    Clock,
    GridClock,
    RoundedClock,
    StateClock,
    UniformClock,
    at_time,
    clock_of,
    more_times,
    outputs,
    refuse_far_times,
    refuse_times,
    uniform_clock,
)
from lieint_jax._integrate._driver import Body, Progress, counted, march, prepared, scanned, step_at_node, steps
from lieint_jax._integrate._event import Event, event, events
from lieint_jax._integrate._halved import halved_steps, splits
from lieint_jax._integrate._interpolate import interpolate
from lieint_jax._integrate._run import (
    integrate,
    intervals,
    join_start,
    of_any_length,
    rows_for,
    saves,
    trajectory,
)

__all__ = [
    "MOST_TO_OUTPUTS",
    "Adjoint",
    "Body",
    "Clock",
    "Event",
    "GridClock",
    "Progress",
    "RoundedClock",
    "StateClock",
    "UniformClock",
    "at_time",
    "clock_of",
    "counted",
    "event",
    "events",
    "halved_steps",
    "integrate",
    "interpolate",
    "intervals",
    "join_start",
    "march",
    "more_times",
    "of_any_length",
    "outputs",
    "prepared",
    "refuse_far_times",
    "refuse_times",
    "rows_for",
    "saves",
    "scanned",
    "splits",
    "step_at_node",
    "steps",
    "trajectory",
    "uniform_clock",
]
