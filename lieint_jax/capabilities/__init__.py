"""Capabilities: abstract systems with their equations of motion.

A system declares by inheritance that it moves by the equations of a capability, such as `AbstractFreeBody`, which has
its phase space and codes its vector field. A scheme integrates the equations of some capabilities: it accepts the
systems that inherit one of them, and refuses those that override one of its equations (`Capability.overridden`), which
`schemes.extrapolate` integrates.
"""

from lieint_jax.capabilities._capability import Capability, equation
from lieint_jax.capabilities._deforming import (
    AbstractDeformingBody,
    AbstractElasticBody,
    AbstractIncompressibleBody,
    AbstractViscousBody,
)
from lieint_jax.capabilities._forces import AbstractDrivenSystem, AbstractForcedSystem
from lieint_jax.capabilities._kinematics import AbstractKinematics
from lieint_jax.capabilities._on_groups import (
    AbstractGeodesicFlow,
    AbstractMechanicalSystem,
    AbstractMetricSystem,
    AbstractRightGeodesicFlow,
    spatial_force,
)
from lieint_jax.capabilities._one_body import (
    AbstractBodyInTime,
    AbstractDampedBody,
    AbstractDrivenGyrostat,
    AbstractEmbeddedBody,
    AbstractFreeBody,
    AbstractFreeBodyInTime,
    AbstractGyrostat,
    AbstractRotatingBody,
    AbstractTorquedBody,
    AbstractTorquedBodyInTime,
)
from lieint_jax.capabilities._several_bodies import (
    AbstractDissipativeBodies,
    AbstractFreeBodies,
    AbstractManyBodies,
    AbstractRigidBodies,
    rotations,
)
from lieint_jax.capabilities._sphere import AbstractSphereSystem
from lieint_jax.capabilities._tops import AbstractDrivenTop, AbstractTop, discrete_gradient

__all__ = [
    "AbstractBodyInTime",
    "AbstractDampedBody",
    "AbstractDeformingBody",
    "AbstractDissipativeBodies",
    "AbstractDrivenGyrostat",
    "AbstractDrivenSystem",
    "AbstractDrivenTop",
    "AbstractElasticBody",
    "AbstractEmbeddedBody",
    "AbstractForcedSystem",
    "AbstractFreeBodies",
    "AbstractFreeBody",
    "AbstractFreeBodyInTime",
    "AbstractGeodesicFlow",
    "AbstractGyrostat",
    "AbstractIncompressibleBody",
    "AbstractKinematics",
    "AbstractManyBodies",
    "AbstractMechanicalSystem",
    "AbstractMetricSystem",
    "AbstractRightGeodesicFlow",
    "AbstractRigidBodies",
    "AbstractRotatingBody",
    "AbstractSphereSystem",
    "AbstractTop",
    "AbstractTorquedBody",
    "AbstractTorquedBodyInTime",
    "AbstractViscousBody",
    "Capability",
    "discrete_gradient",
    "equation",
    "rotations",
    "spatial_force",
]
