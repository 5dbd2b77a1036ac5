"""The spherical pendulum on T*S², the paper's introductory example (Section 1.1)."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import MomentumMap, Scalar, Vector3
from lieint_jax.core import State, callable_pytree, pytree
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractSphereSystem
from lieint_jax.systems._shared.arguments import explained

__all__ = ["Pendulum", "pendulum"]


@pytree
class UniformGravity:
    """g(s) = strength·s: a uniform field."""

    strength: Array

    def __call__(self, s: Scalar) -> Scalar:
        return self.strength * s


@pytree
class Pendulum(AbstractSphereSystem):
    """H = |π|²/(2m) − g(γ·q) (1.3); q̇ = π × q/m, π̇ = −q × ∇V(q) with V(q) = −g(γ·q) (1.1), (1.4).

    Made by `pendulum`.
    """

    mass: Array
    field: Callable[[Array], Array]  # g
    axis: Array

    @explained
    def state(
        self, direction: ArrayLike, *, velocity: ArrayLike | None = None, momentum: ArrayLike | None = None
    ) -> State:
        """The state of a direction and one of two ways to give the motion.

        Args:
            direction: q, a unit vector to 1e-6, shape (3,); it is normalized.
            velocity: q̇, shape (3,), tangent to the sphere.
            momentum: π = m q × q̇, shape (3,), with q·π = 0.

        Raises:
            ValueError: not exactly one of the two, a wrong shape, a NaN, |q| ≠ 1, or a component along q above 1e-6 of
                the vector.
        """
        name, given = _checks.one_of(velocity=velocity, momentum=momentum)
        q = _unit("direction", direction)
        vector = _checks.real_array(name, given, (3,))
        along = vectors.dot(q, vector)
        if concrete(along) and abs(float(along)) > _checks.UNIT_TOLERANCE * np.linalg.norm(np.asarray(vector, float)):
            raise ValueError(f"{name} must be orthogonal to q: its component on q is {float(along):.3g}; subtract it")
        vector = vector - along * q
        p = vector if name == "momentum" else self.mass * jnp.cross(q, vector)
        dtype = jnp.result_type(q, p)
        return State(q.astype(dtype), p.astype(dtype))

    def potential(self, q: Vector3) -> Scalar:
        """V(q) = −g(γ·q), defined off the sphere too."""
        return -self.field(vectors.dot(self.axis, q))

    def energy(self, state: State) -> Scalar:
        """|π|²/(2m) − g(γ·q) (1.3)."""
        return vectors.dot(state.p, state.p) / (2 * self.mass) + self.potential(state.q)

    def momentum(self, state: State) -> MomentumMap:
        """γ·π (1.5), shape (1,)."""
        return vectors.dot(self.axis, state.p)[None]

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        q, p = _checks.real_array("state.q", state.q, (3,)), _checks.real_array("state.p", state.p, (3,))
        if concrete(q, p) and float(self.phase_space.defect(state)) > 2 * _checks.UNIT_TOLERANCE:
            raise ValueError("state must have |q| = 1 and q·π = 0 to 1e-6; make it with pendulum.state(...)")


def pendulum(
    mass: ArrayLike, gravity: ArrayLike | Callable[[Array], Array], axis: ArrayLike = (0.0, 0.0, -1.0)
) -> Pendulum:
    """A particle on the unit sphere in a field along an axis, V(q) = −g(γ·q).

    Args:
        mass: m > 0. (For a pendulum of length l, give m l² here and m l times the acceleration as g.)
        gravity: an acceleration G, for the uniform field g(s) = m G s; or any smooth function g, an energy (a function
            with parameters is a `jax.tree_util.Partial`).
        axis: γ, the direction of the field: downwards; a unit vector to 1e-6.

    Raises:
        ValueError: m not positive, γ not a unit vector, a wrong shape or a NaN.

    Source: Lewis & Simo 1994, (1.3)–(1.5); Simo & Gonzalez 1993.

    Example:
        >>> swing = pendulum(mass=1.0, gravity=9.81)
        >>> state = swing.state([1.0, 0.0, 0.0], velocity=[0.0, 1.0, 0.0])
        >>> float(swing.energy(state))
        0.5
    """
    m = _checks.positive("mass", mass)
    if callable(gravity):
        _checks.function("gravity", gravity, "γ·q", (), jnp.zeros((), m.dtype))
    else:
        gravity = UniformGravity(m * _checks.real_array("gravity", gravity, (), like=m))
    return Pendulum(m, callable_pytree(gravity), _unit("axis", axis, like=m))


def _unit(name: str, value: ArrayLike, like: Array | None = None) -> Vector3:
    v = _checks.unit_vector(name, value, like=like)
    return v / jnp.linalg.norm(v)


def _quadratic(s: Scalar) -> Scalar:
    return s + s * s / 2


PROPERTIES = SystemProperties(
    name="pendulum",
    models="a point on the unit sphere",
    phase_space="T*S²: unit vector, π",
    conserves=("energy", "momentum"),
    momentum="γ·π about the axis",
    sizes=(1,),
    aliases=("spherical pendulum",),
    source="Lewis & Simo 1994, (1.3)–(1.5)",
)


def examples() -> dict[str, tuple[Pendulum, State, float]]:
    """A uniform field, and one that grows with depth; both swing around the axis."""
    direction, velocity = np.array([0.6, 0.0, -0.8]), np.array([0.0, 0.7, 0.0])
    bobs = {"uniform": pendulum(1.0, 1.0), "quadratic": pendulum(1.5, _quadratic)}
    return {name: (bob, bob.state(direction, velocity=velocity), 0.1) for name, bob in bobs.items()}
