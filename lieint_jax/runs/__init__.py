"""A step and states make a run: of one body or many, in memory or on disk, with events and output at any times.

`integrate` is for the inside of jit, vmap and grad; `run` for results that are kept. `store` reads and writes runs on
disk, and `processes` are those of a run on several machines.
"""

from lieint_jax.runs import processes, store
from lieint_jax.runs._clock import (
    MOST_COUNTED,
    Clock,
    GridClock,
    UniformClock,
    at_time,
    clock_of,
    halved_steps,
    intervals,
    refuse_far_times,
    refuse_times,
    saves,
    splits,
    uniform_clock,
)
from lieint_jax.runs._driver import (
    Reached,
    at_start,
    counted,
    info_since,
    prepared,
    reported,
    saved_states,
    step_at_node,
    steps,
)
from lieint_jax.runs._event import Event, event, events
from lieint_jax.runs._execute import compute
from lieint_jax.runs._integrate import (
    Adjoint,
    at_output_times,
    integrate,
    join_start,
    of_any_length,
    rows_for,
    trajectory,
)
from lieint_jax.runs._interpolate import interpolate
from lieint_jax.runs._job import MakeStates, Summary
from lieint_jax.runs._layout import count_cores, first_devices, want_devices
from lieint_jax.runs._loop import Reduction, compiler_options, energy
from lieint_jax.runs._make_run import open_run, run, untransformed
from lieint_jax.runs._memory import peak_memory
from lieint_jax.runs._over_members import over_members
from lieint_jax.runs._part_of_task import part_of_task, part_of_text
from lieint_jax.runs._run import Run
from lieint_jax.runs._submit import Executor, submit

__all__ = [
    "MOST_COUNTED",
    "Adjoint",
    "Clock",
    "Event",
    "Executor",
    "GridClock",
    "MakeStates",
    "Reached",
    "Reduction",
    "Run",
    "Summary",
    "UniformClock",
    "at_output_times",
    "at_start",
    "at_time",
    "clock_of",
    "compiler_options",
    "compute",
    "count_cores",
    "counted",
    "energy",
    "event",
    "events",
    "first_devices",
    "halved_steps",
    "info_since",
    "integrate",
    "interpolate",
    "intervals",
    "join_start",
    "of_any_length",
    "open_run",
    "over_members",
    "part_of_task",
    "part_of_text",
    "peak_memory",
    "prepared",
    "processes",
    "refuse_far_times",
    "refuse_times",
    "reported",
    "rows_for",
    "run",
    "saved_states",
    "saves",
    "splits",
    "step_at_node",
    "steps",
    "store",
    "submit",
    "trajectory",
    "uniform_clock",
    "untransformed",
    "want_devices",
]
