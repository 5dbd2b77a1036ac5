"""The core types: states, steps, trajectories, groups, phase spaces, systems and their capabilities.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.

A capability is an abstract class below, such as `AbstractFreeBody`, whose docstring states equations of motion. A
system declares by inheritance that it moves by them. A scheme accepts only the systems that declare the capability
that it integrates.
"""

from __future__ import annotations

from lieint_jax._deprecated import renamed as _renamed
from lieint_jax.types._capabilities import (
    AbstractDampedBody,
    AbstractDissipativeBodies,
    AbstractDrivenGyrostat,
    AbstractDrivenSystem,
    AbstractDrivenTop,
    AbstractElasticBody,
    AbstractEmbeddedBody,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractGeodesicFlow,
    AbstractGyrostat,
    AbstractIncompressibleBody,
    AbstractMechanicalSystem,
    AbstractRightGeodesicFlow,
    AbstractRigidBodies,
    AbstractSphereSystem,
    AbstractTop,
    AbstractTorquedBody,
    AbstractViscousBody,
    PotentialWithGradient,
    StoredEnergy,
    autodiff_gradient,
    gradient,
)
from lieint_jax.types._catalogue import Catalogue
from lieint_jax.types._group import AnalyticGroup, Group, PhaseSpace
from lieint_jax.types._pair_law import PairLaw, pair_forces
from lieint_jax.types._pytree import Partitioned, argument, callable_pytree, pytree, static
from lieint_jax.types._state import State, StepInfo, Trajectory, all_finite, clock, counts_work
from lieint_jax.types._step import Step, StepError, checked_step, converges, promoted, start_time
from lieint_jax.types._system import System, energy_less_work, time_derivative
from lieint_jax.types._tangents import push_forward
from lieint_jax.types._torque import Function, Law, Rotation, Total, as_law, instant, labels, parts, total

__all__ = [
    "AbstractDampedBody",
    "AbstractDissipativeBodies",
    "AbstractDrivenGyrostat",
    "AbstractDrivenSystem",
    "AbstractDrivenTop",
    "AbstractElasticBody",
    "AbstractEmbeddedBody",
    "AbstractForcedSystem",
    "AbstractFreeBodies",
    "AbstractFreeBody",
    "AbstractGeodesicFlow",
    "AbstractGyrostat",
    "AbstractIncompressibleBody",
    "AbstractMechanicalSystem",
    "AbstractRightGeodesicFlow",
    "AbstractRigidBodies",
    "AbstractSphereSystem",
    "AbstractTop",
    "AbstractTorquedBody",
    "AbstractViscousBody",
    "AnalyticGroup",
    "Catalogue",
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
    "checked_step",
    "clock",
    "converges",
    "counts_work",
    "energy_less_work",
    "gradient",
    "instant",
    "labels",
    "pair_forces",
    "parts",
    "promoted",
    "push_forward",
    "pytree",
    "start_time",
    "static",
    "time_derivative",
    "total",
]

__getattr__ = _renamed(
    __name__,
    {
        "FreeBody": "AbstractFreeBody",
        "Gyrostat": "AbstractGyrostat",
        "DrivenGyrostat": "AbstractDrivenGyrostat",
        "EmbeddedBody": "AbstractEmbeddedBody",
        "GeodesicFlow": "AbstractGeodesicFlow",
        "RightGeodesicFlow": "AbstractRightGeodesicFlow",
        "FreeBodies": "AbstractFreeBodies",
        "Top": "AbstractTop",
        "ElasticBody": "AbstractElasticBody",
        "IncompressibleBody": "AbstractIncompressibleBody",
        "DrivenTop": "AbstractDrivenTop",
        "TorquedBody": "AbstractTorquedBody",
        "DampedBody": "AbstractDampedBody",
        "Forced": "AbstractForcedSystem",
        "Driven": "AbstractDrivenSystem",
        "OnSphere": "AbstractSphereSystem",
        "Bodies": "AbstractRigidBodies",
        "MechanicalSystem": "AbstractMechanicalSystem",
        "SteepPotential": "PotentialWithGradient",
    },
)
