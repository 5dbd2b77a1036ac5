"""Potentials of several rigid bodies, (positions (N, 3), rotations body to space (N, 3, 3)) ↦ V; they can be added.

| | |
|---|---|
| `mutual_gravity`, `maccullagh` | gravity of shapes: to order 4, to order 2 by moments of inertia |
| `ellipsoid_sphere`, `point_masses` | gravity: of an ellipsoid and a sphere, of mascons |
| `point_charges`, `lennard_jones`, `sites` | molecules: charges, dispersion, both |
| `molecule`, `water` | a rigid molecule of sites, with its principal axes; TIP4P water |
| `springs`, `uniform_field`, `outer_field` | springs between bodies; fields from outside, uniform or any |

Any function of positions and rotations is a potential too; autodiff then computes forces and torques. `symmetry` gives
the momenta that a potential conserves.
"""

from lieint_jax._deprecated import renamed as _renamed
from lieint_jax.potentials._ellipsoid_sphere import EllipsoidSphere, ellipsoid_sphere
from lieint_jax.potentials._maccullagh import MacCullagh, maccullagh
from lieint_jax.potentials._molecule import Molecule, molecule
from lieint_jax.potentials._mutual_gravity import MutualGravity, mutual_gravity
from lieint_jax.potentials._outer_field import OuterField, UniformField, outer_field, uniform_field
from lieint_jax.potentials._potential import Potential, SumPotential, count, invariant_form, symmetry, torques
from lieint_jax.potentials._site_pairs import (
    InverseDistance,
    LennardJones,
    lennard_jones,
    point_charges,
    point_masses,
    sites,
)
from lieint_jax.potentials._springs import Springs, springs
from lieint_jax.potentials._water import water

__all__ = [
    "EllipsoidSphere",
    "InverseDistance",
    "LennardJones",
    "MacCullagh",
    "Molecule",
    "MutualGravity",
    "OuterField",
    "Potential",
    "Springs",
    "SumPotential",
    "UniformField",
    "count",
    "ellipsoid_sphere",
    "invariant_form",
    "lennard_jones",
    "maccullagh",
    "molecule",
    "mutual_gravity",
    "outer_field",
    "point_charges",
    "point_masses",
    "sites",
    "springs",
    "symmetry",
    "torques",
    "uniform_field",
    "water",
]

__getattr__ = _renamed(
    __name__,
    {"Sum": "SumPotential"},
)
