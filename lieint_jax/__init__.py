"""Conserving time integrators for Hamiltonian systems on Lie groups, in JAX.

A system and a scheme make a step; a step and states make a run.

    import jax, lieint_jax as li

    jax.config.update("jax_enable_x64", True)  # float64

    body = li.systems.rigid_body(inertia=[1.0, 2.0, 3.0])
    step = li.schemes.so3_midpoint(body, kappa=li.maps.kappa_symplectic)
    state = body.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    run = li.run(step, state, dt=0.05, num_steps=1000)
    print(run, abs(run.energy_error()).max())
    print(li.diagnostics.certify(step, state, dt=0.05, num_steps=1000))  # what is conserved, to how many digits

| | |
|---|---|
| `systems` | rigid bodies, tops, satellites, several bodies, elastic bodies, any matrix group |
| `schemes` | the integrators: `help(li.schemes)` lists which one fits which system |
| `run`, `open` | runs that you keep, of one body or of many, over cores, devices and processes, in memory or on disk |
| `integrate`, `event`, `interpolate` | inside jit, vmap, grad: trajectories, and when a condition changes its sign |
| `submit` | a run in parts on a cluster: Dask, SLURM, MPI, any executor |
| `over_members`, `count_cores` | any function over the members of a batch, on all cores, and how many there are |
| `StoreOptions`, `peak_memory`, `part_of_task` | what large runs need: units of a store, memory, the part of a task |
| `equilibrium`, `normal_modes` | relative equilibria, frequencies of small oscillations, stability |
| `diagnostics` | what a step conserves, its order, its linearization; chaos |
| `measure` | what a run shows: periods, librations, orbits, spectra, light curves |
| `ReversibleAdjoint`, `RecursiveCheckpointAdjoint` | gradients of long runs, by `integrate(…, adjoint=…)` |
| `fit` | fits; bounds, noise and inference in `fitting` |
| `transition` | state transition matrices, sensitivities to parameters, linear covariance |
| `shapes` | mass, inertia and moments of ellipsoids, boxes, point masses, meshes |
| `potentials`, `torques`, `tides`, `orbits` | what acts on bodies |
| `attitude` | attitudes from other conventions: scalar last, matrices, Euler angles, modified Rodrigues parameters |
| `files`, `dates` | files that people bring and take away, and their dates |
| `plots`, `report` | pictures and the report of a run |
| `groups`, `maps`, `phase_spaces`, `core` | the mathematics below: groups, scalings κ, symplectic forms, states |
| `elliptic` | elliptic integrals and functions, with derivatives |
| `scan`, `engine`, `explain` | `jax.lax.scan` in machine code, for your own loops; which engine runs a loop, and why |
| `jit`, `cache_programs` | `jax.jit` that compiles sooner; compiled programs on disk for the next process |

`run` and `integrate` save every step by default: `save_every` changes that.
Attitudes are unit quaternions (w, x, y, z), body to space. Momenta are in the axes of space. Any consistent units may
be used. `lieint list` on the command line lists examples, systems and schemes.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lieint_jax._version import __version__

if TYPE_CHECKING:
    from lieint_jax import (
        attitude,
        core,
        dates,
        diagnostics,
        elliptic,
        files,
        fitting,
        groups,
        maps,
        measure,
        orbits,
        phase_spaces,
        plots,
        potentials,
        report,
        schemes,
        shapes,
        systems,
        tides,
        torques,
    )
    from lieint_jax._cache import cache_programs
    from lieint_jax._xla import jit
    from lieint_jax.core import State, Step, StepInfo, Trajectory, pytree, static
    from lieint_jax.diagnostics import equilibrium, normal_modes
    from lieint_jax.fitting import fit
    from lieint_jax.native import engine, explain, scan
    from lieint_jax.runs import (
        Event,
        RecursiveCheckpointAdjoint,
        ReversibleAdjoint,
        Run,
        StoreOptions,
        count_cores,
        event,
        integrate,
        interpolate,
        over_members,
        part_of_task,
        peak_memory,
        run,
        submit,
        transition,
    )
    from lieint_jax.runs import open_run as open  # noqa: A004

__all__ = [
    "Event",
    "RecursiveCheckpointAdjoint",
    "ReversibleAdjoint",
    "Run",
    "State",
    "Step",
    "StepInfo",
    "StoreOptions",
    "Trajectory",
    "__version__",
    "attitude",
    "cache_programs",
    "core",
    "count_cores",
    "dates",
    "diagnostics",
    "elliptic",
    "engine",
    "equilibrium",
    "event",
    "explain",
    "files",
    "fit",
    "fitting",
    "groups",
    "integrate",
    "interpolate",
    "jit",
    "maps",
    "measure",
    "normal_modes",
    "open",
    "orbits",
    "over_members",
    "part_of_task",
    "peak_memory",
    "phase_spaces",
    "plots",
    "potentials",
    "pytree",
    "report",
    "run",
    "scan",
    "schemes",
    "shapes",
    "static",
    "submit",
    "systems",
    "tides",
    "torques",
    "transition",
]

_PLACES = {  # of the names that are no modules themselves
    "_cache": ("cache_programs",),
    "_xla": ("jit",),
    "core": ("State", "Step", "StepInfo", "Trajectory", "pytree", "static"),
    "diagnostics": ("equilibrium", "normal_modes"),
    "fitting": ("fit",),
    "native": ("engine", "explain", "scan"),
    "runs": (
        *("Event", "RecursiveCheckpointAdjoint", "ReversibleAdjoint", "Run", "StoreOptions", "count_cores", "event"),
        *("integrate", "interpolate", "open", "over_members", "part_of_task", "peak_memory", "run", "submit"),
        "transition",
    ),
}
_PLACE = {name: place for place, names in _PLACES.items() for name in names}


def _find(name: str) -> Any:
    """A room, or what a room has, imported when it is asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'lieint_jax' has no attribute {name!r}")
    if name in ("schemes", "Step"):
        importlib.import_module("lieint_jax.runs")  # which gives a step inside `jax.shard_map` its loop
    place = importlib.import_module(f"lieint_jax.{_PLACE.get(name, name)}")
    return place if name not in _PLACE else getattr(place, "open_run" if name == "open" else name)


if not TYPE_CHECKING:  # a type checker finds a wrong name by itself

    def __getattr__(name: str) -> Any:
        found = globals()[name] = _find(name)
        return found


__dir__ = __all__.copy
