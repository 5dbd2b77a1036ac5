# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.orbits._air import *
from lieint_jax.orbits._earth import *
from lieint_jax.orbits._frames import *
from lieint_jax.orbits._from_state import *
from lieint_jax.orbits._graded_times import *
from lieint_jax.orbits._kepler import *
from lieint_jax.orbits._magnetic import *
from lieint_jax.orbits._secular import *
from lieint_jax.orbits._shared import *
from lieint_jax.orbits._sun import *
from lieint_jax.orbits._table import *
