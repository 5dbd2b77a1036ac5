"""Hamiltonian systems. Each module has `examples()`: systems with a state worth integrating and a time step."""

from lieint_jax.systems.euler import Euler, euler
from lieint_jax.systems.group_potential import GroupPotential, group_potential
from lieint_jax.systems.heavy_top import heavy_top
from lieint_jax.systems.pendulum import Pendulum, pendulum
from lieint_jax.systems.potential_top import PotentialTop, potential_top
from lieint_jax.systems.pseudo_rigid import (
    PseudoRigidBody,
    StoredEnergy,
    mooney_rivlin,
    neo_hookean,
    pseudo_rigid_body,
    saint_venant_kirchhoff,
)
from lieint_jax.systems.rigid_body import RigidBody, rigid_body

__all__ = [
    "Euler",
    "GroupPotential",
    "Pendulum",
    "PotentialTop",
    "PseudoRigidBody",
    "RigidBody",
    "StoredEnergy",
    "euler",
    "group_potential",
    "heavy_top",
    "mooney_rivlin",
    "neo_hookean",
    "pendulum",
    "potential_top",
    "pseudo_rigid_body",
    "rigid_body",
    "saint_venant_kirchhoff",
]
