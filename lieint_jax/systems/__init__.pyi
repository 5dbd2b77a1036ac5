# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.systems._catalogue import *
from lieint_jax.systems._damped_body import *
from lieint_jax.systems._driven_gyrostat import *
from lieint_jax.systems._driven_top import *
from lieint_jax.systems._embedded_body import *
from lieint_jax.systems._equations import *
from lieint_jax.systems._euler import *
from lieint_jax.systems._gravity_gradient import *
from lieint_jax.systems._group_potential import *
from lieint_jax.systems._gyrostat import *
from lieint_jax.systems._heavy_top import *
from lieint_jax.systems._incompressible_body import *
from lieint_jax.systems._inertia_in_time import *
from lieint_jax.systems._kinematics import *
from lieint_jax.systems._maclaurin import *
from lieint_jax.systems._pendulum import *
from lieint_jax.systems._potential_top import *
from lieint_jax.systems._pseudo_rigid_body import *
from lieint_jax.systems._rigid_bodies import *
from lieint_jax.systems._rigid_body import *
from lieint_jax.systems._rod import *
from lieint_jax.systems._self_gravity import *
from lieint_jax.systems._torqued_body import *
