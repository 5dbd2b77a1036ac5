# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.types._catalogue import *
from lieint_jax.types._group import *
from lieint_jax.types._pair_law import *
from lieint_jax.types._potentials import *
from lieint_jax.types._pytree import *
from lieint_jax.types._state import *
from lieint_jax.types._step import *
from lieint_jax.types._system import *
from lieint_jax.types._torque import *
