"""A step and states make a run: of one body or many, in memory or on disk, with events and output at any times.

`integrate` is for the inside of jit, vmap and grad; `run` for results that are kept. `store` reads and writes runs on
disk.
"""

from lieint_jax.runs import store
from lieint_jax.runs._host.error import RunError, estimate
from lieint_jax.runs._host.make_run import open_run, run
from lieint_jax.runs._host.memory import peak_memory
from lieint_jax.runs._host.run import Run
from lieint_jax.runs._host.submit import Executor, LostWorkerError, PermanentError, submit
from lieint_jax.runs._job.devices import count_cores, first_devices, want_devices
from lieint_jax.runs._job.loop import Reduction, compiler_options
from lieint_jax.runs._job.made_states import MakeStates
from lieint_jax.runs._job.over_members import over_members
from lieint_jax.runs._job.part_of_task import part_of_task
from lieint_jax.runs._march.adjoints import RecursiveCheckpointAdjoint, ReversibleAdjoint
from lieint_jax.runs._march.clock import (
    UniformClock,
    at_time,
    clock_of,
    halved_steps,
    intervals,
    saves,
    uniform_clock,
)
from lieint_jax.runs._march.driver import (
    counted,
    prepared,
    reported,
    step_at_node,
    steps,
)
from lieint_jax.runs._march.event import Event, event, events
from lieint_jax.runs._march.integrate import (
    integrate,
    of_any_length,
    rows_for,
    trajectory,
)
from lieint_jax.runs._march.interpolate import interpolate
from lieint_jax.runs._march.transition import Ellipse, Transition, transition
from lieint_jax.runs._storage.storage import StoreOptions
from lieint_jax.runs._summary import Summary

__all__ = [
    "Ellipse",
    "Event",
    "Executor",
    "LostWorkerError",
    "MakeStates",
    "PermanentError",
    "RecursiveCheckpointAdjoint",
    "Reduction",
    "ReversibleAdjoint",
    "Run",
    "RunError",
    "StoreOptions",
    "Summary",
    "Transition",
    "UniformClock",
    "at_time",
    "clock_of",
    "compiler_options",
    "count_cores",
    "counted",
    "estimate",
    "event",
    "events",
    "first_devices",
    "halved_steps",
    "integrate",
    "interpolate",
    "intervals",
    "of_any_length",
    "open_run",
    "over_members",
    "part_of_task",
    "peak_memory",
    "prepared",
    "reported",
    "rows_for",
    "run",
    "saves",
    "step_at_node",
    "steps",
    "store",
    "submit",
    "trajectory",
    "transition",
    "uniform_clock",
    "want_devices",
]
