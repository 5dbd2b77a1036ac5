"""Files that people bring and take away. Each reader returns plain objects of this package.

| file | read | written |
|---|---|---|
| shapes of triangles: OBJ, STL, PLY, DAMIT, PDS; others with trimesh | `read_shape` | |
| robots: URDF, MJCF | `read_urdf_inertia`, `read_mjcf_inertia` | |
| molecules: xyz, PDB | `read_molecule`, `read_molecules` | |
| light curves: DAMIT, ALCDEF | `read_light_curves` | |
"""

from lieint_jax.files._light_curves import LightCurve, read_light_curves
from lieint_jax.files._molecules import Atoms, Superposition, read_molecule, read_molecules
from lieint_jax.files._robots import read_mjcf_inertia, read_urdf_inertia
from lieint_jax.files._shapes import read_shape

__all__ = [
    "Atoms",
    "LightCurve",
    "Superposition",
    "read_light_curves",
    "read_mjcf_inertia",
    "read_molecule",
    "read_molecules",
    "read_shape",
    "read_urdf_inertia",
]
