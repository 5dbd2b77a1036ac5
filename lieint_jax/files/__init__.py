"""Files that people bring and take away. Each reader returns plain objects of this package.

| file | read | written |
|---|---|---|
| any of these: what it is, and what can be done with it | `identify`, `describe` | |
| an orbit: CCSDS OEM | `read_oem` | `write_oem` |
| attitudes: CCSDS AEM | `read_aem` | `write_aem` |
| mean elements of SGP4: TLE, CCSDS OMM | `read_tle`, `read_omm` | |
| an orbit: vector tables of JPL Horizons, CSV | `read_horizons`, `read_ephemeris_csv` | |
| shapes of triangles: OBJ, STL, PLY, DAMIT, PDS; others with trimesh | `read_shape` | |
| robots: URDF, MJCF | `read_urdf_inertia`, `read_mjcf_inertia` | |
| molecules: xyz, PDB | `read_molecule`, `read_molecules` | |
| light curves: DAMIT, ALCDEF | `read_light_curve`, `read_light_curves` | |
| logs of gyros and star trackers, CSV | `read_csv_log` | `write_csv` |
"""

from lieint_jax.files._aem import Attitudes, read_aem, write_aem
from lieint_jax.files._csv_log import read_csv_log, write_csv
from lieint_jax.files._describe import describe
from lieint_jax.files._horizons import read_ephemeris_csv, read_horizons
from lieint_jax.files._identify import identify
from lieint_jax.files._light_curves import read_light_curve, read_light_curves
from lieint_jax.files._molecules import Atoms, Superposition, read_molecule, read_molecules
from lieint_jax.files._oem import read_oem, write_oem
from lieint_jax.files._orbit_table import OrbitTable
from lieint_jax.files._robots import read_mjcf_inertia, read_urdf_inertia
from lieint_jax.files._shapes import read_shape
from lieint_jax.files._tle import Elements, MeanElements, read_omm, read_tle

__all__ = [
    "Atoms",
    "Attitudes",
    "Elements",
    "MeanElements",
    "OrbitTable",
    "Superposition",
    "describe",
    "identify",
    "read_aem",
    "read_csv_log",
    "read_ephemeris_csv",
    "read_horizons",
    "read_light_curve",
    "read_light_curves",
    "read_mjcf_inertia",
    "read_molecule",
    "read_molecules",
    "read_oem",
    "read_omm",
    "read_shape",
    "read_tle",
    "read_urdf_inertia",
    "write_aem",
    "write_csv",
    "write_oem",
]
__dir__ = __all__.copy
