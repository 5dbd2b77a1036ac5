"""Hamiltonian systems. Each has `state(…)`, which returns a state from attitude and angular velocity.

| system | |
|---|---|
| `rigid_body` | a free rigid body; `body.solution(state, t)` is its motion in closed form |
| `gyrostat`, `driven_gyrostat` | with a wheel of constant momentum, or one that a motor drives |
| `damped_body`, `torqued_body` | with internal friction, or with any torque (`li.torques`) |
| `gravity_gradient` | a satellite or a moon on a given orbit (`li.orbits`) |
| `heavy_top`, `potential_top`, `driven_top` | a body with a fixed point, in any potential, which may depend on time |
| `rigid_bodies` | any number of bodies in any potential of positions and attitudes (`li.potentials`) |
| `pendulum` | a point on the unit sphere |
| `pseudo_rigid_body`, `incompressible_body` | an elastic body that deforms homogeneously; its stored energies are |
| | `mooney_rivlin`, `neo_hookean`, `saint_venant_kirchhoff`, `self_gravity`, or any function |
| `euler`, `kirchhoff`, `manakov` | geodesics of any matrix group: bodies in a fluid, in n dimensions |
| `group_potential` | the same with a potential |
| `embedded_body` | a free body whose attitude is a 3×3 matrix, for the paper's refutations |

`catalogue()` lists what each conserves, with its phase space, names in the literature and source.

Integrals and closed forms to test with: `lagrange_motion`, `kovalevskaya_integral`, `clebsch_integral`,
`manakov_integrals`. Each module has `examples()`: systems with a state worth integrating and a time step.
"""

import sys as _sys

from lieint_jax._deprecated import renamed as _renamed
from lieint_jax._discover import modules_with_examples as _modules_with_examples
from lieint_jax.systems._damped_body import DampedBody, damped_body
from lieint_jax.systems._driven_gyrostat import DrivenGyrostat, SpinUpMotor, driven_gyrostat
from lieint_jax.systems._driven_top import DrivenTop, driven_top
from lieint_jax.systems._embedded_body import EmbeddedBody, embedded_body
from lieint_jax.systems._euler import Euler, RightEuler, euler, kirchhoff, manakov, manakov_integrals
from lieint_jax.systems._gravity_gradient import GravityGradient, gravity_gradient
from lieint_jax.systems._group_potential import DrivenGroupPotential, GroupPotential, group_potential
from lieint_jax.systems._gyrostat import Gyrostat, gyrostat
from lieint_jax.systems._heavy_top import (
    LagrangeMotion,
    LinearPotential,
    heavy_top,
    kovalevskaya_integral,
    lagrange_motion,
)
from lieint_jax.systems._incompressible_body import IncompressibleBody, incompressible_body
from lieint_jax.systems._pendulum import Pendulum, pendulum
from lieint_jax.systems._potential_top import PotentialTop, QuadraticPotential, clebsch_integral, potential_top
from lieint_jax.systems._pseudo_rigid_body import (
    PseudoRigidBody,
    StoredEnergy,
    ViscousBody,
    mooney_rivlin,
    neo_hookean,
    pseudo_rigid_body,
    saint_venant_kirchhoff,
)
from lieint_jax.systems._rigid_bodies import DissipativeBodies, FreeBodies, RigidBodies, rigid_bodies
from lieint_jax.systems._rigid_body import RigidBody, rigid_body
from lieint_jax.systems._shared.properties import SystemProperties
from lieint_jax.systems._shared.self_gravity import SelfGravity, self_gravity
from lieint_jax.systems._torqued_body import TorquedBody, torqued_body
from lieint_jax.types import Catalogue

__all__ = [
    "DampedBody",
    "DissipativeBodies",
    "DrivenGroupPotential",
    "DrivenGyrostat",
    "DrivenTop",
    "EmbeddedBody",
    "Euler",
    "FreeBodies",
    "GravityGradient",
    "GroupPotential",
    "Gyrostat",
    "IncompressibleBody",
    "LagrangeMotion",
    "LinearPotential",
    "Pendulum",
    "PotentialTop",
    "PseudoRigidBody",
    "QuadraticPotential",
    "RightEuler",
    "RigidBodies",
    "RigidBody",
    "SelfGravity",
    "SpinUpMotor",
    "StoredEnergy",
    "SystemProperties",
    "TorquedBody",
    "ViscousBody",
    "catalogue",
    "clebsch_integral",
    "damped_body",
    "driven_gyrostat",
    "driven_top",
    "embedded_body",
    "euler",
    "gravity_gradient",
    "group_potential",
    "gyrostat",
    "heavy_top",
    "incompressible_body",
    "kirchhoff",
    "kovalevskaya_integral",
    "lagrange_motion",
    "manakov",
    "manakov_integrals",
    "mooney_rivlin",
    "neo_hookean",
    "pendulum",
    "potential_top",
    "pseudo_rigid_body",
    "rigid_bodies",
    "rigid_body",
    "saint_venant_kirchhoff",
    "self_gravity",
    "torqued_body",
]


def catalogue() -> Catalogue[SystemProperties]:
    """The systems as a table: what each models and conserves, its phase space, names in the literature and source.

    Returns:
        A tuple of `SystemProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    return Catalogue(module.PROPERTIES for module in _modules_with_examples(_sys.modules[__name__]).values())


__getattr__ = _renamed(
    __name__,
    {"ManyFreeBodies": "FreeBodies", "SpinUp": "SpinUpMotor", "Quadratic": "QuadraticPotential"},
)
