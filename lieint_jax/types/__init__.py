"""The core types: states, steps, trajectories, groups, phase spaces and systems.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.
"""

from __future__ import annotations

from lieint_jax._deprecated import renamed as _renamed
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

_CAPABILITIES = """
    DampedBody DissipativeBodies DrivenGyrostat DrivenSystem DrivenTop ElasticBody EmbeddedBody ForcedSystem
    FreeBodies FreeBody GeodesicFlow Gyrostat IncompressibleBody MechanicalSystem RightGeodesicFlow RigidBodies
    SphereSystem Top TorquedBody ViscousBody
"""
__getattr__ = _renamed(
    __name__,
    {
        **{f"Abstract{name}": f"lieint_jax.capabilities:Abstract{name}" for name in _CAPABILITIES.split()},
        "FreeBody": "lieint_jax.capabilities:AbstractFreeBody",
        "Gyrostat": "lieint_jax.capabilities:AbstractGyrostat",
        "DrivenGyrostat": "lieint_jax.capabilities:AbstractDrivenGyrostat",
        "EmbeddedBody": "lieint_jax.capabilities:AbstractEmbeddedBody",
        "GeodesicFlow": "lieint_jax.capabilities:AbstractGeodesicFlow",
        "RightGeodesicFlow": "lieint_jax.capabilities:AbstractRightGeodesicFlow",
        "FreeBodies": "lieint_jax.capabilities:AbstractFreeBodies",
        "Top": "lieint_jax.capabilities:AbstractTop",
        "ElasticBody": "lieint_jax.capabilities:AbstractElasticBody",
        "IncompressibleBody": "lieint_jax.capabilities:AbstractIncompressibleBody",
        "DrivenTop": "lieint_jax.capabilities:AbstractDrivenTop",
        "TorquedBody": "lieint_jax.capabilities:AbstractTorquedBody",
        "DampedBody": "lieint_jax.capabilities:AbstractDampedBody",
        "Forced": "lieint_jax.capabilities:AbstractForcedSystem",
        "Driven": "lieint_jax.capabilities:AbstractDrivenSystem",
        "OnSphere": "lieint_jax.capabilities:AbstractSphereSystem",
        "Bodies": "lieint_jax.capabilities:AbstractRigidBodies",
        "MechanicalSystem": "lieint_jax.capabilities:AbstractMechanicalSystem",
        "SteepPotential": "PotentialWithGradient",
    },
)
