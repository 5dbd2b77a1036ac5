# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.core._catalogue import *
from lieint_jax.core._group import *
from lieint_jax.core._law import *
from lieint_jax.core._pair_law import *
from lieint_jax.core._potentials import *
from lieint_jax.core._pytree import *
from lieint_jax.core._state import *
from lieint_jax.core._step import *
from lieint_jax.core._system import *
