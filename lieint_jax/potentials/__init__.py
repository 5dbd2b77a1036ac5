"""Potentials of several rigid bodies, (positions (N, 3), rotations body to space (N, 3, 3)) ↦ V; they can be added.

| | |
|---|---|
| `mutual_gravity`, `maccullagh` | gravity of shapes: to order 4, to order 2 by moments of inertia |
| `polyhedron` | gravity of a mesh on points and small bodies, exact at any distance |
| `ellipsoid_sphere`, `point_masses` | gravity: of an ellipsoid and a sphere, of mascons |
| `point_charges`, `lennard_jones`, `sites` | molecules: charges, dispersion, both |
| `molecule`, `water` | a rigid molecule of sites, with its principal axes; TIP4P water |
| `rod`, `held` | the stored energy of a chain of cross sections; its ends clamped or driven |
| `springs`, `uniform_field`, `outer_field` | springs between bodies; fields from outside, uniform or any |

Any function of positions and rotations is a potential too; autodiff then computes forces and torques. `force` gives
these of any potential, `symmetry` the momenta that it conserves.
"""

from lieint_jax._discover import publish as _publish

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
