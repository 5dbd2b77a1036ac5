"""Hamiltonian systems. Each module has `examples()`: systems with a state worth integrating and a time step."""

from lieint_jax.systems.rigid_body import RigidBody, rigid_body

__all__ = ["RigidBody", "rigid_body"]
