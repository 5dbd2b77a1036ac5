"""The implicit equations of a step, F(x) = 0: a scheme states them, and here they are solved.

Derivatives of a root are exact, see `_numerics.newton`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from lieint_jax._numerics import newton
from lieint_jax.types import StepInfo

_CONVERGED = 32  # eps: the largest last change of an iteration that converged
_Unknown = TypeVar("_Unknown")
_Linear = Callable[[_Unknown], _Unknown]


class ImplicitEquation(abc.ABC, Generic[_Unknown]):
    """F(x) = 0, solved by Newton's method."""

    @abc.abstractmethod
    def residual(self, x: _Unknown, /) -> _Unknown:
        """F(x)."""

    @abc.abstractmethod
    def correction(self, x: _Unknown, F: _Unknown, /) -> _Unknown:
        """Newton's step F'(x)⁻¹F, which is subtracted."""

    @abc.abstractmethod
    def report(self, x: _Unknown, F: _Unknown, steady: Array, /) -> StepInfo:
        """Whether x is a root at round-off on the branch from Δt = 0, by F(x) and the `steady` of `newton.root`."""

    def solve(self, guess: _Unknown, iterations: int, **options: Any) -> tuple[_Unknown, StepInfo]:
        """The root near a guess, and the report on it. The options are those of `newton.root`."""
        x, F, steady = newton.root(self.residual, self.correction, guess, iterations, **options)
        return x, self.report(x, F, steady)


class FixedPointEquation(abc.ABC, Generic[_Unknown]):
    """F(x) = 0, solved by iterations x ← G(x) until x no longer changes."""

    @abc.abstractmethod
    def residual(self, x: _Unknown, /) -> _Unknown:
        """F(x)."""

    @abc.abstractmethod
    def improve(self, x: _Unknown, /) -> tuple[_Unknown, Array]:
        """G(x), and its relative change."""

    def inverses(self) -> tuple[_Linear[_Unknown], _Linear[_Unknown]]:
        """F ↦ an approximation of F'⁻¹F at the root, and the one of its transpose; by default both are F ↦ F."""
        return (lambda F: F), (lambda F: F)

    def iterate(self, x: _Unknown, most: int, enough: float) -> tuple[_Unknown, Array]:
        """The last iterate and its change."""
        dtype = jax.tree.leaves(x)[0].dtype
        return newton.iterate_until_stalled(self.improve, x, dtype, most, enough)

    def solve(self, guess: _Unknown, most: int, enough: float, refinements: int) -> tuple[_Unknown, StepInfo]:
        """The root near a guess, and the report: the last change, and whether it is round-off.

        Args:
            guess: the first iterate.
            most: the most iterations.
            enough: the change, in eps, at which they end.
            refinements: iterations of the linear equations for derivatives.
        """

        def solve(_: _Linear[_Unknown], x: _Unknown) -> tuple[_Unknown, Array]:
            return self.iterate(x, most, enough)

        def tangent_solve(linear: _Linear[_Unknown], b: _Unknown) -> _Unknown:
            return _refined(linear, b, self.inverses(), refinements)

        x, change = newton.implicit_root(self.residual, guess, solve, tangent_solve)
        change = lax.stop_gradient(change)
        return x, StepInfo(change, change <= _CONVERGED * float(jnp.finfo(change.dtype).eps))


def _refined(
    linear: _Linear[_Unknown], b: _Unknown, inverses: tuple[_Linear[_Unknown], _Linear[_Unknown]], refinements: int
) -> _Unknown:
    """x with linear(x) = b by refinement with an approximate inverse, and the derivative with that of the transpose."""
    flat, parts = ravel_pytree(b)  # one array: parts of b may depend on nothing that is differentiated

    def solver(inverse: _Linear[_Unknown]) -> Callable[[Callable[[Array], Array], Array], Array]:
        def correction(residual: Array) -> Array:
            return ravel_pytree(inverse(parts(residual)))[0]

        def solve(matvec: Callable[[Array], Array], b: Array) -> Array:
            return lax.fori_loop(0, refinements, lambda _, v: v + correction(b - matvec(v)), correction(b))

        return solve

    matvec = lambda v: ravel_pytree(linear(parts(v)))[0]  # noqa: E731
    forward, transposed = map(solver, inverses)
    return parts(lax.custom_linear_solve(matvec, flat, forward, transposed))
