"""A step and states make a run: of one body or many, in memory or on disk, with events and output at any times.

`integrate` is for the inside of jit, vmap and grad; `run` for results that are kept. `store` reads and writes runs on
disk.
"""

from lieint_jax import native
from lieint_jax.core import Step
from lieint_jax.runs import store
from lieint_jax.runs._adjoints import RecursiveCheckpointAdjoint, ReversibleAdjoint
from lieint_jax.runs._clock import (
    UniformClock,
    at_time,
    clock_of,
    halved_steps,
    intervals,
    saves,
    uniform_clock,
)
from lieint_jax.runs._devices import count_cores, first_devices, want_devices
from lieint_jax.runs._driver import (
    counted,
    prepared,
    reported,
    step_at_node,
    steps,
)
from lieint_jax.runs._error import RunError, estimate
from lieint_jax.runs._events import Event, event, events
from lieint_jax.runs._integrate import (
    integrate,
    of_any_length,
    rows_for,
    trajectory,
)
from lieint_jax.runs._interpolate import interpolate
from lieint_jax.runs._loop import Reduction, compiler_options
from lieint_jax.runs._made_states import MakeStates
from lieint_jax.runs._make_run import open_run, run
from lieint_jax.runs._memory import peak_memory
from lieint_jax.runs._over_members import over_members
from lieint_jax.runs._part_of_task import part_of_task
from lieint_jax.runs._run import Run
from lieint_jax.runs._storage.storage import StoreOptions
from lieint_jax.runs._submit import Executor, LostWorkerError, PermanentError, submit
from lieint_jax.runs._summary import Summary
from lieint_jax.runs._transition import Ellipse, Transition, transition

Step.loop_in_shards = staticmethod(native.scan)  # the core does not import the compiler

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
