"""Batches of bodies over devices and processes, with results in memory or on disk, and a report of failures.

`run(step, states, dt, num_steps)` integrates a batch in one compiled loop. With `store=` it writes results while it
runs and can be resumed; with `reduce=` it returns a summary in place of states; with `part=` it is one of many
independent processes. `open(path)` returns a stored run and its system; `archives` reads files of results one array at
a time. `over_members` applies any function of one member to all members, over all devices; `count_cores` returns the
number of cores that this process may use, `part_of_task` the part of this task in a job array, `part_of_text` that of
an option K/N or auto; `peak_memory` the memory of a run, beforehand.
"""

from lieint_jax.ensemble import archives, processes
from lieint_jax.ensemble._job import Summary
from lieint_jax.ensemble._layout import count_cores, first_devices, want_devices
from lieint_jax.ensemble._loop import compiler_options, energy
from lieint_jax.ensemble._memory import peak_memory
from lieint_jax.ensemble._over_members import over_members
from lieint_jax.ensemble._part_of_task import part_of_task, part_of_text
from lieint_jax.ensemble._reading import open_run as open  # noqa: A004
from lieint_jax.ensemble._run import run
from lieint_jax.ensemble._store_options import StoreOptions

__all__ = [
    "StoreOptions",
    "Summary",
    "archives",
    "compiler_options",
    "count_cores",
    "energy",
    "first_devices",
    "open",
    "over_members",
    "part_of_task",
    "part_of_text",
    "peak_memory",
    "processes",
    "run",
    "want_devices",
]
