"""The core types: states, steps, trajectories, groups, phase spaces and systems.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.
"""

from __future__ import annotations

import importlib
from typing import Any

from lieint_jax._deprecated import warn_of_removal
from lieint_jax.types._catalogue import Catalogue
from lieint_jax.types._group import AnalyticGroup, Group, PhaseSpace
from lieint_jax.types._pair_law import ChainLaw, PairLaw, pair_forces
from lieint_jax.types._potentials import (
    PotentialWithGradient,
    StoredEnergy,
    autodiff_gradient,
    check_gradient,
    gradient,
)
from lieint_jax.types._pytree import Partitioned, argument, callable_pytree, pytree, static
from lieint_jax.types._state import State, StepInfo, Trajectory, all_finite, clock, counts_work, periods_of
from lieint_jax.types._step import Step, StepError, checked_step, converges, promoted, start_time
from lieint_jax.types._system import System, energy_less_work, time_derivative
from lieint_jax.types._tangents import push_forward
from lieint_jax.types._torque import Function, Law, Rotation, Total, as_law, instant, labels, laws_of, parts, total

__all__ = [
    "AnalyticGroup",
    "Catalogue",
    "ChainLaw",
    "Function",
    "Group",
    "Law",
    "PairLaw",
    "Partitioned",
    "PhaseSpace",
    "PotentialWithGradient",
    "Rotation",
    "State",
    "Step",
    "StepError",
    "StepInfo",
    "StoredEnergy",
    "System",
    "Total",
    "Trajectory",
    "all_finite",
    "argument",
    "as_law",
    "autodiff_gradient",
    "callable_pytree",
    "check_gradient",
    "checked_step",
    "clock",
    "converges",
    "counts_work",
    "energy_less_work",
    "gradient",
    "instant",
    "labels",
    "laws_of",
    "pair_forces",
    "parts",
    "periods_of",
    "promoted",
    "push_forward",
    "pytree",
    "start_time",
    "static",
    "time_derivative",
    "total",
]


def __getattr__(name: str) -> Any:
    if name.startswith("Abstract") and hasattr(
        capabilities := importlib.import_module("lieint_jax.capabilities"), name
    ):
        warn_of_removal(f"li.types.{name} is now li.capabilities.{name}; the old name")
        return getattr(capabilities, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
