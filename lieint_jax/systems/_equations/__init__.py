"""Equations of motion: abstract systems with a phase space and a vector field.

A system declares by inheritance by which equations it moves, such as those of `AbstractFreeBody`. A scheme integrates
some of them: it accepts the systems that inherit these, and refuses those that override one of their equations
(`Equations.overridden`), which `schemes.extrapolate` integrates.

Those that several systems share are public in `li.systems`. Where one system has the equations, users subclass the
system; they stand here because schemes import no system, with the closed forms and checks that it brings along.
"""

from lieint_jax.systems._equations.damped import AbstractDampedBody
from lieint_jax.systems._equations.deforming import (
    AbstractDeformingBody,
    AbstractElasticBody,
    AbstractIncompressibleBody,
    AbstractViscousBody,
)
from lieint_jax.systems._equations.embedded import AbstractEmbeddedBody
from lieint_jax.systems._equations.equation import Equations, equation
from lieint_jax.systems._equations.forces import AbstractDrivenSystem, AbstractForcedSystem
from lieint_jax.systems._equations.kinematics import AbstractKinematics
from lieint_jax.systems._equations.on_groups import (
    AbstractGeodesicFlow,
    AbstractMechanicalSystem,
    AbstractMetricSystem,
    AbstractRightGeodesicFlow,
    spatial_force,
)
from lieint_jax.systems._equations.one_body import (
    AbstractBodyInTime,
    AbstractDrivenGyrostat,
    AbstractFreeBody,
    AbstractFreeBodyInTime,
    AbstractGyrostat,
    AbstractRotatingBody,
)
from lieint_jax.systems._equations.several_bodies import (
    AbstractDissipativeBodies,
    AbstractFreeBodies,
    AbstractManyBodies,
    AbstractRigidBodies,
    rotations,
)
from lieint_jax.systems._equations.sphere import AbstractSphereSystem
from lieint_jax.systems._equations.tops import AbstractDrivenTop, AbstractTop, discrete_gradient
from lieint_jax.systems._equations.torqued import AbstractTorquedBody, AbstractTorquedBodyInTime

__all__ = [
    "AbstractBodyInTime",
    "AbstractDeformingBody",
    "AbstractDissipativeBodies",
    "AbstractDrivenSystem",
    "AbstractDrivenTop",
    "AbstractForcedSystem",
    "AbstractFreeBody",
    "AbstractManyBodies",
    "AbstractMetricSystem",
    "AbstractRigidBodies",
    "AbstractRotatingBody",
    "Equations",
    "equation",
]
