# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.potentials._ellipsoid_sphere import *
from lieint_jax.potentials._held import *
from lieint_jax.potentials._maccullagh import *
from lieint_jax.potentials._molecule import *
from lieint_jax.potentials._mutual_gravity import *
from lieint_jax.potentials._outer_field import *
from lieint_jax.potentials._polyhedron import *
from lieint_jax.potentials._potential import *
from lieint_jax.potentials._rod import *
from lieint_jax.potentials._site_pairs import *
from lieint_jax.potentials._springs import *
