"""Dissipative laws: viscous drag, a sphere in a fluid inside the body, internal friction."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from jax import Array

from lieint_jax._checks import all_plain, named, not_negative, positive
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import Scalar, Vector, VectorLike, cross, dot
from lieint_jax.core import Converted, Law, Rotation, argument, pytree, static
from lieint_jax.torques._arguments import dissipative_tensor, tensor_of

__all__ = ["KaneDamper", "Viscous", "internal_friction", "kane_damper", "viscous"]


@pytree
class Viscous(Law):
    """Linear drag of the surroundings, T = −DΩ: its work in a step is −Δt Ω̄·DΩ̄, never positive.

    Args:
        damping: D, torque × time: a number, principal values (3,), or a symmetric tensor (3, 3); not negative.

    Raises:
        ValueError: a negative D, or none of these shapes.
    """

    damping: Converted[Array] = argument(converter=named(dissipative_tensor, "damping"))

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """−DΩ̄."""
        return -jnp.stack(tensor_of(self.damping) @ rotation.Omega), inner


@pytree
class KaneDamper(Law):
    """Kane's damper: a sphere at the center that a viscous fluid couples to the body, τ = −c(ω − ω_d).

    The momentum of both, π + π_d, is conserved to round-off, and the energy of both falls by Δt c|ω̄ − ω̄_d|² in a
    step, until they rotate together about the body's axis of largest inertia. J is the body's without the sphere.

    Args:
        inertia: I_d > 0, the sphere's moment of inertia.
        damping: c ≥ 0, torque × time.
        key: the name of the sphere's momentum in `State.extra`; several dampers need several names.

    Raises:
        ValueError: I_d ≤ 0, c < 0.

    Source: Kane, Likins & Levinson 1983, Spacecraft Dynamics; the implicit mean of a step: this package.
    """

    inertia: Converted[Array] = argument(converter=named(positive, "inertia"))
    damping: Converted[Array] = argument(converter=named(not_negative, "damping"))
    key: str = static(default="damper")  # pyright: ignore[reportIncompatibleVariableOverride]
    frame = "space"
    internal = True

    @property
    def label(self) -> str:
        return "kane_damper" if self.key == "damper" else self.key

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """−c(ω̄ − ω̄_d) with I_d ω̄_d = π_d + ½Δt c(ω̄ − ω̄_d), the mean momentum of the sphere."""
        slip = (rotation.omega - inner / self.inertia) / (1 + self.damping * rotation.dt / (2 * self.inertia))
        torque = -self.damping * slip
        return torque, inner - rotation.dt * torque

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """½|π_d|²/I_d."""
        return dot(inner, inner) / (2 * self.inertia)

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        """−Δt c|ω̄ − ω̄_d|²."""
        slip = rotation.omega - (inner + after) / (2 * self.inertia)
        return -rotation.dt * self.damping * dot(slip, slip)

    def start(self, now: Rotation) -> Array:
        """The momentum of the sphere where it rotates with the body."""
        return self.inertia * now.omega

    def momentum(self, q: Array, inner: PyTree) -> Array:
        """π_d."""
        return inner


def internal_friction(friction: Scalar, Pi: VectorLike, Omega: VectorLike) -> Vector:
    """α Π × Ω, the angular velocity that internal friction adds to Ω (`systems.damped_body`), in components.

    Π̇ = Π × (Ω + αΠ × Ω), the double bracket: |Π| and π stay, and Ḣ = −α|Π × Ω|², until the body rotates about its
    axis of largest inertia with H = |π|²/2J₃.

    Source: Bloch, Krishnaprasad, Marsden & Ratiu 1996, Commun. Math. Phys. 175.
    """
    all_plain(friction=friction, Pi=Pi, Omega=Omega)
    return friction * cross(Pi, Omega)


viscous, kane_damper = Viscous, KaneDamper


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {
        "viscous": partial(viscous, damping=jnp.array([1.3, 1.7, 2.2])),
        "kane_damper": partial(kane_damper, inertia=0.3, damping=0.2, key="damper"),
        "internal_friction": partial(internal_friction, friction=0.1, Pi=(0.6, -0.3, 0.5), Omega=(0.5, -0.3, 0.6)),
    }
