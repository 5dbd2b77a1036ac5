"""The base of the potentials of several rigid bodies: sums, symmetry, forces, and quadratic invariants."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial
from jax.typing import ArrayLike

from lieint_jax._checks import all_plain
from lieint_jax._numerics.arrays import Calls, PoseMomenta, Positions, Rotations, Scalar
from lieint_jax._numerics.gradients import autodiff_gradient, discrete_gradient
from lieint_jax.core import Partitioned, State, callable_pytree, clock, pytree

__all__ = [
    "Potential",
    "SumPotential",
    "at_time",
    "count",
    "domain",
    "force",
    "given_poses",
    "invariant_form",
    "is_chain",
    "is_driven",
    "symmetry",
    "torques",
]

_APART = 1e-6  # above this |ΔI|²/|I|² the quadrature is corrected so that D·ΔI = ΔV exactly


class Potential:
    """A potential V(x, Λ) of N rigid bodies, called with positions (N, 3) and rotations, body to space, (N, 3, 3).

    A subclass defines `__call__`, and may define `force(x, R)`, the forces and torques in closed form, (N, 6).

    Or it defines `invariants(x, R)`, functions quadratic in (x, R), (k,), or a tuple of such arrays, and V as their
    function `value`, and may define `discrete_gradient(I0, I1)`. By these the energy–momentum scheme conserves energy,
    and those components of P and L that generate symmetries of the invariants. Without them they are the poses relative
    to the first body.
    """

    chain = False  # whether each body acts only on the one before and the one after it
    domain = ""  # where V is defined, in words; "" if everywhere
    driven = False  # whether it has poses that are given functions of time, `poses(t)`, and `at(t)` with those constant

    def __call__(self, x: Positions, R: Rotations) -> Scalar:
        return self.value(self.invariants(x, R))

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ in space, (N, 6); by default by autodiff of V."""
        along_x, along_R = autodiff_gradient(self, (0, 1))(x, R)
        return jnp.concatenate([-along_x, torques(R, along_R)], axis=1)

    def invariants(self, x: Positions, R: Rotations) -> Any:
        """Functions quadratic in positions and rotations, (k,) or a pytree of such arrays."""
        return relative(x, R)

    def value(self, invariants: Any) -> Scalar:
        """V of the invariants."""
        n = invariants.size // 12
        xi, C = invariants[: 3 * n].reshape(n, 3), invariants[3 * n :].reshape(n, 3, 3)
        one = jnp.eye(3, dtype=invariants.dtype)[None]
        return self(jnp.concatenate([jnp.zeros_like(xi[:1]), xi]), jnp.concatenate([one, C]))

    def discrete_gradient(self, start: Any, end: Any) -> Any:
        """D with D·(I₁ − I₀) = V(I₁) − V(I₀), symmetric; by default by quadrature."""
        return discrete_gradient(self.value, start, end, apart=_APART)

    @property
    def count(self) -> int | None:
        """N, or None if the potential accepts any number of bodies."""
        return None

    def with_bodies(self, masses: Array, inertias: Array) -> Potential:
        """The potential of bodies of these masses (N,) and inertias (N, 3) or (N, 3, 3), for `systems.rigid_bodies`."""
        return self

    @property
    def symmetry(self) -> Array | None:
        """The orthogonal projector (6, 6) to the conserved part of (P, L); None if P and L are conserved."""
        return None

    def __add__(self, other: Callable[[Array, Array], Array]) -> SumPotential:
        return SumPotential((*_terms(self), *_terms(other)))

    def __radd__(self, other: Callable[[Array, Array], Array]) -> SumPotential:
        return SumPotential((*_terms(other), *_terms(self)))


@pytree
class SumPotential(Potential):
    """A sum of potentials and functions of positions and rotations, made by `+`."""

    terms: tuple[Callable[[Array, Array], Array], ...]

    def __call__(self, x: Positions, R: Rotations) -> Scalar:
        return reduce(jnp.add, (term(x, R) for term in self.terms))

    def with_bodies(self, masses: Array, inertias: Array) -> SumPotential:
        bound = (t.with_bodies(masses, inertias) if isinstance(t, Potential) else t for t in self.terms)
        return SumPotential(tuple(bound))

    @property
    def count(self) -> int | None:
        counts = {n for n in (count(term) for term in self.terms) if n is not None}
        if len(counts) > 1:
            raise ValueError(f"the terms of a sum must have the same number of bodies, got {sorted(counts)}")
        return counts.pop() if counts else None

    @property
    def chain(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return all(map(is_chain, self.terms))

    @property
    def domain(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return ". ".join(filter(None, map(domain, self.terms)))

    @property
    def symmetry(self) -> Array | None:
        broken = [S for S in (symmetry(term) for term in self.terms) if S is not None]
        if len(broken) < 2:
            return broken[0] if broken else None
        lost, axes = jnp.linalg.eigh(sum(jnp.eye(6) - S for S in broken))
        kept = axes * (lost < 1e-9)
        return kept @ kept.T

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces and torques, (N, 6): in closed form of the terms that have one, by autodiff of the others."""
        return reduce(jnp.add, (force(term, x, R) for term in self.terms))

    def invariants(self, x: Positions, R: Rotations) -> tuple[Any, ...]:
        """The invariants of every term."""
        return tuple(as_potential(term).invariants(x, R) for term in self.terms)

    def value(self, invariants: tuple[Any, ...]) -> Scalar:
        """V of the invariants."""
        pairs = zip(self.terms, invariants, strict=True)
        return reduce(jnp.add, (as_potential(term).value(own) for term, own in pairs))

    def discrete_gradient(self, start: tuple[Any, ...], end: tuple[Any, ...]) -> tuple[Any, ...]:
        """The discrete gradient of every term."""
        pairs = zip(self.terms, start, end, strict=True)
        return tuple(as_potential(term).discrete_gradient(I0, I1) for term, I0, I1 in pairs)


class _Function(Potential):
    """A function of positions and rotations, as a potential."""

    def __init__(self, function: Callable[[Array, Array], Array]) -> None:
        self.function = function

    def __call__(self, x: Positions, R: Rotations) -> Scalar:
        return self.function(x, R)


def as_potential(potential: Callable[[Array, Array], Array]) -> Potential:
    """A potential itself, or a plain function as one."""
    own = potential.whole if isinstance(potential, Partitioned) else potential
    return own if isinstance(own, Potential) else _Function(potential)


def count(potential: Callable[[Array, Array], Array]) -> int | None:
    """The number of bodies of a potential or a plain function, None if it accepts any number."""
    return as_potential(potential).count


def symmetry(potential: Callable[[Array, Array], Array]) -> Array | None:
    """The projector to the part of (P, L) that a potential or a plain function conserves; None if all is conserved."""
    return as_potential(potential).symmetry


def is_chain(potential: Callable[[Array, Array], Array]) -> bool:
    """Whether by a potential or a plain function each body acts only on the one before and the one after it."""
    return as_potential(potential).chain


def domain(potential: Callable[[Array, Array], Array]) -> str:
    """Where a potential or a plain function is defined, in words; "" if everywhere."""
    return as_potential(potential).domain


def is_driven(potential: Callable[[Array, Array], Array]) -> bool:
    """Whether a potential or a plain function has poses that are given functions of time."""
    return as_potential(potential).driven


def at_time(potential: Callable[[Array, Array], Array], t: Array | None) -> Callable[[Array, Array], Array]:
    """A potential with the poses that are given functions of time at their values at t; others are unchanged."""
    return potential.at(t) if is_driven(potential) else potential  # pyright: ignore


def given_poses(potential: Callable[[Array, Array], Array], state: State, late: ArrayLike = 0.0) -> tuple[Array, ...]:
    """The further arguments of `invariants`: given poses a time `late` after that of a state, or none."""
    return potential.poses(clock(state) + late) if is_driven(potential) else ()  # pyright: ignore


def torques(R: Rotations, along_R: Rotations) -> Positions:
    """−∂V(exp(δ̂)R)/∂δ at δ = 0 of each body, (N, 3), where ∂V/∂R is `along_R`, both (N, 3, 3)."""
    all_plain(R=R, along_R=along_R)
    turned = [[jnp.sum(along_R[:, i] * R[:, j], axis=1) for j in range(3)] for i in range(3)]
    return jnp.stack([turned[j][i] - turned[i][j] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)


def force(potential: Callable[[Array, Array], Array], x: Positions, R: Rotations) -> PoseMomenta:
    """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ in space, (N, 6): in closed form, or by autodiff of V."""
    all_plain(x=x, R=R)
    return as_potential(potential).force(x, R)


def invariant_form(potential: Callable[[Array, Array], Array]) -> Potential:
    """A potential by its `invariants`, their function `value`, and a `discrete_gradient`; a plain function, too."""
    return as_potential(potential)


def relative(x: Positions, R: Rotations) -> Array:
    """Positions and attitudes relative to the first body, in its axes, (12 (N − 1),)."""
    first = R[0]
    xi = jnp.sum(first[None] * (x[1:] - x[:1])[:, :, None], axis=1)
    C = jnp.sum(first[None, :, :, None] * R[1:, :, None, :], axis=1)
    return jnp.concatenate([xi.ravel(), C.ravel()])


def _terms(potential: Callable[[Array, Array], Array]) -> tuple[Callable[[Array, Array], Array], ...]:
    if not callable(potential):
        raise TypeError(
            f"a potential is added to potentials and functions of positions and rotations, got {potential!r}"
        )
    return potential.terms if isinstance(potential, SumPotential) else (callable_pytree(potential),)


def _attraction(k: Array, x: Array, R: Array) -> Array:
    """A potential, for the examples."""
    return k * jnp.sum((x[0] - x[1]) ** 2) + jnp.sum(R[0] * R[1])


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    R = jnp.stack([jnp.eye(3), jnp.eye(3)[jnp.array([1, 2, 0])]])
    bodies = Partial(_attraction, jnp.array(1.3))
    return {
        "force": partial(force, potential=bodies, x=jnp.array([[0.0, 0.1, 0.2], [4.0, 1.0, -0.5]]), R=R),
        "torques": partial(torques, R=R, along_R=R[::-1] + 0.1),
    }
