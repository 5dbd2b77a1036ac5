"""A chain of bodies whose first or last body has a given pose, constant or a function of time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import concrete, named
from lieint_jax._numerics.arrays import Calls, PoseMomenta, Positions, Rotations, Scalar
from lieint_jax.core import Converted, argument, callable_pytree, pytree, with_fields
from lieint_jax.groups import so3
from lieint_jax.potentials._potential import Potential
from lieint_jax.potentials._rod import rod

__all__ = ["Held", "held"]

Pose = Array | Callable[[Array], Array] | None  # (7,), or t ↦ (7,)


def _without_ends(potential: Potential) -> Potential:
    if not isinstance(potential, Potential):
        raise ValueError(f"potential must be one of lieint_jax.potentials, got {potential!r}")
    if potential.driven:
        raise ValueError("the ends of this potential are held already: give both ends in one call of potentials.held")
    return potential


def _pose(name: str, end: Any) -> Array | Callable[[Array], Array]:
    if callable(end):
        _checks.function(name, end, "the time", (7,), jax.ShapeDtypeStruct((), jnp.result_type(float)))
        return callable_pytree(end)
    pose = _checks.real_array(name, end, (7,))
    if concrete(pose):
        _checks.unit_quaternion(name, pose[3:], (4,))
    return jnp.concatenate([pose[:3], so3.normalize(pose[3:])])


@pytree
class Held(Potential):
    """The potential of a chain with its first body, its last or both at given poses: clamped or driven ends.

    The given bodies are no bodies of the system: of a potential of N bodies with one end held, N − 1 move. P and L are
    not conserved. With an end driven, only `schemes.bodies_energy_momentum` integrates the bodies, and `State.work`
    counts the work of the end.

    Args:
        potential: of all bodies, one of `lieint_jax.potentials`.
        first, last: a pose (x, y, z, qw, qx, qy, qz), (7,), with a unit quaternion body to space, or a function t ↦
            pose, or None for a body that moves.

    Raises:
        ValueError: no end is given, a pose has a wrong shape or no unit quaternion, or the potential is not one of
            `lieint_jax.potentials`.
    """

    potential: Converted[Potential] = argument(converter=_without_ends)
    first: Converted[Pose] = argument(converter=named(_pose, "first", optional=True), default=None)
    last: Converted[Pose] = argument(converter=named(_pose, "last", optional=True), default=None)

    def check_fields(self) -> None:
        """Raise ValueError if no end is given."""
        if self.first is None and self.last is None:
            raise ValueError("held needs a pose of the first or the last body, got neither")

    @property
    def count(self) -> int | None:
        every = self.potential.count
        return None if every is None else every - sum(end is not None for end in (self.first, self.last))

    @property
    def chain(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.potential.chain

    @property
    def driven(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return callable(self.first) or callable(self.last)

    @property
    def domain(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.potential.domain

    @property
    def symmetry(self) -> Array:
        """The projector (6, 6) to the conserved part of (P, L): 0, as forces and torques act on the given bodies."""
        return jnp.zeros((6, 6))

    def at(self, t: Any) -> Held:
        """The same with the poses at the time t, constant."""
        first, last = (end(t) if callable(end) else end for end in (self.first, self.last))
        return with_fields(self, first=first, last=last)

    def poses(self, t: Any) -> tuple[Array, Array]:
        """The positions (h, 3) and rotations (h, 3, 3) of the given bodies at the time t."""
        given = self.at(t)
        q = jnp.stack([jnp.asarray(end) for end in (given.first, given.last) if end is not None])
        return q[:, :3], jax.vmap(so3.to_matrix)(q[:, 3:])

    def joined(self, moving: Array, given: Array) -> Array:
        """Rows of all bodies in their order, from those of the moving and of the given ones."""
        first = int(self.first is not None)
        return jnp.concatenate([given[:first], moving, given[first:]])

    def invariants(self, x: Positions, R: Rotations, *given: Array) -> Any:
        """The invariants of the potential of all bodies, with the given poses at `given` if they are functions of time.

        Raises:
            ValueError: poses are functions of time, and `given` is missing.
        """
        return self.potential.invariants(*self._all_bodies(x, R, *given))

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces and torques on the moving bodies, (N, 6).

        Raises:
            ValueError: poses are functions of time.
        """
        first = int(self.first is not None)
        return self.potential.force(*self._all_bodies(x, R))[first : first + len(x)]

    def _all_bodies(self, x: Positions, R: Rotations, *given: Array) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) of all bodies, with the constant poses or those at `given`."""
        if not given and self.driven:
            raise ValueError("a body moves in a given way, so the potential depends on time: use potential.at(t)")
        at, turned = given or self.poses(None)
        return self.joined(x, at.astype(x.dtype)), self.joined(R, turned.astype(R.dtype))

    def value(self, invariants: Any) -> Scalar:
        """V of the invariants."""
        return self.potential.value(invariants)

    def discrete_gradient(self, start: Any, end: Any) -> Any:
        """The discrete gradient of the potential of all bodies."""
        return self.potential.discrete_gradient(start, end)

    def __add__(self, other: Any) -> Any:
        self._check_constant()
        return super().__add__(other)

    def __radd__(self, other: Any) -> Any:
        self._check_constant()
        return super().__radd__(other)

    def _check_constant(self) -> None:
        if self.driven:
            raise ValueError("add potentials of all bodies before ends are held: potentials.held(a + b, …)")


held = Held


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    chain = rod([0.7, 0.7], (1.3, 1.1, 2.0), (0.3, 0.4, 0.2))
    first = jnp.array([0.3, -0.5, 0.7, 0.8, -0.4, 0.4, 0.2])
    last = jnp.array([0.5, 0.7, 0.9, 0.8, -0.4, 0.4, 0.2])
    return {"held": partial(held, potential=chain, first=first, last=last)}
