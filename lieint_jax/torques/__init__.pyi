# Written by tests/lib/stubs.py: each module has its public names in __all__.

from lieint_jax.torques._actuators import *
from lieint_jax.torques._control import *
from lieint_jax.torques._damping import *
from lieint_jax.torques._law import *
from lieint_jax.torques._magnetic import *
from lieint_jax.torques._modified_law import *
from lieint_jax.torques._pointing import *
from lieint_jax.torques._potential import *
from lieint_jax.torques._sampled import *
from lieint_jax.torques._surfaces import *
from lieint_jax.torques._thruster import *
from lieint_jax.torques._wheels import *
