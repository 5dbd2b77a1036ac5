# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.schemes._additive import *
from lieint_jax.schemes._bodies_energy_momentum import *
from lieint_jax.schemes._calibrated import *
from lieint_jax.schemes._catalogue import *
from lieint_jax.schemes._compose import *
from lieint_jax.schemes._exact import *
from lieint_jax.schemes._extrapolate import *
from lieint_jax.schemes._gauss import *
from lieint_jax.schemes._group_alpha import *
from lieint_jax.schemes._group_energy_momentum import *
from lieint_jax.schemes._group_midpoint import *
from lieint_jax.schemes._kepler_splitting import *
from lieint_jax.schemes._langevin import *
from lieint_jax.schemes._log_hamiltonian import *
from lieint_jax.schemes._magnus import *
from lieint_jax.schemes._nystrom import *
from lieint_jax.schemes._preprocessed import *
from lieint_jax.schemes._so3_alpha import *
from lieint_jax.schemes._so3_explicit import *
from lieint_jax.schemes._so3_midpoint import *
from lieint_jax.schemes._sphere_midpoint import *
from lieint_jax.schemes._splitting import *
from lieint_jax.schemes._top_energy_momentum import *
from lieint_jax.schemes._torqued_midpoint import *
