"""Files that people bring and take away. Each reader returns plain objects of this package.

| file | read | written |
|---|---|---|
| an orbit: CCSDS OEM | `read_oem` | `write_oem` |
| attitudes: CCSDS AEM | `read_aem` | `write_aem` |
| mean elements of SGP4: TLE, CCSDS OMM | `read_tle`, `read_omm` | |
| an orbit: vector tables of JPL Horizons, CSV | `read_horizons`, `read_ephemeris_csv` | |
"""

from lieint_jax.files._aem import Attitudes, read_aem, write_aem
from lieint_jax.files._horizons import read_ephemeris_csv, read_horizons
from lieint_jax.files._oem import read_oem, write_oem
from lieint_jax.files._orbit_table import OrbitTable
from lieint_jax.files._tle import Elements, MeanElements, read_omm, read_tle

__all__: list[str] = [
    "Attitudes",
    "Elements",
    "MeanElements",
    "OrbitTable",
    "read_aem",
    "read_ephemeris_csv",
    "read_horizons",
    "read_oem",
    "read_omm",
    "read_tle",
    "write_aem",
    "write_oem",
]
