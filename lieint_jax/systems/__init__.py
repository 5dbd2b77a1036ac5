"""Hamiltonian systems. Each module has `examples()`: systems with a state worth integrating and a time step."""

from lieint_jax.systems.heavy_top import heavy_top
from lieint_jax.systems.potential_top import PotentialTop, potential_top
from lieint_jax.systems.rigid_body import RigidBody, rigid_body

__all__ = ["PotentialTop", "RigidBody", "heavy_top", "potential_top", "rigid_body"]
