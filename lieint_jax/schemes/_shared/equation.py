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

from lieint_jax._numerics import block_tridiagonal, newton
from lieint_jax._numerics.block_tridiagonal import BlockTridiagonal
from lieint_jax._numerics.small_linalg import Factored
from lieint_jax.core import StepInfo

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
        return newton.iterate_until_stalled(self.improve, x, most, enough)

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
            forward, transposed = self.inverses()
            return _refined(linear, b, lambda _: forward, lambda _: transposed, refinements)

        x, change = newton.implicit_root(self.residual, guess, solve, tangent_solve)
        change = lax.stop_gradient(change)
        return x, StepInfo(change, change <= _CONVERGED * float(jnp.finfo(change.dtype).eps))


class ChainEquation(abc.ABC):
    """F(x) = 0 for the unknowns x (n, k) of a chain, each link of which acts only on those next to it.

    It is solved by Newton's method with block-tridiagonal matrices. Forces between distant links are left out of these:
    the iteration still ends at a root, if they are weak.

    Attributes:
        is_exact: whether no such forces exist.
    """

    is_exact: bool

    @abc.abstractmethod
    def residual(self, x: Array, /) -> Array:
        """F(x), (n, k)."""

    @abc.abstractmethod
    def length(self, step: Array, /) -> Array:
        """The length of a correction, in numbers of order 1."""

    def solve(self, guess: Array, first: Array, unit: Array, most: int) -> tuple[Array, StepInfo]:
        """The root near a guess, and the report: what is missing, and whether it is round-off.

        Args:
            guess: the first iterate.
            first: the length that the first correction may have.
            unit: the length of a rounding error of x, over eps.
            most: the most corrections.
        """
        (n, k), dtype = guess.shape, guess.dtype
        eps = float(jnp.finfo(dtype).eps)
        unit = lax.stop_gradient(unit)
        residual = jax.jit(self.residual, inline=True)  # its equations are many, and used four times

        def factored(linear: _Linear[Array]) -> Factored:
            return block_tridiagonal.factored(BlockTridiagonal.of(linear, n, k, dtype))

        def factored_at(x: Array) -> Factored:
            linear = lambda v: jax.jvp(residual, (x,), (v,))[1]  # noqa: E731
            return factored(jax.linearize(linear, jnp.zeros_like(x))[1])

        def solve(_: _Linear[Array], x: Array) -> tuple[Array, Array]:
            return newton.repeated_chords(residual, factored_at, self.length, x, first, eps * unit, most)

        def tangent_solve(linear: _Linear[Array], b: Array) -> Array:
            inverse = lambda matvec: factored(matvec).solve  # noqa: E731
            return _refined(linear, b, inverse, inverse, 1 if self.is_exact else most)

        x, missing = newton.deferred_root(residual, guess, solve, tangent_solve)
        missing = lax.stop_gradient(missing) / unit
        return x, StepInfo(missing, missing <= _CONVERGED * eps)


def _refined(
    linear: _Linear[_Unknown],
    b: _Unknown,
    forward: Callable[[_Linear[_Unknown]], _Linear[_Unknown]],
    transposed: Callable[[_Linear[_Unknown]], _Linear[_Unknown]],
    refinements: int,
) -> _Unknown:
    """x with linear(x) = b by refinement with an approximate inverse, and the derivative with that of the transpose.

    Each inverse is made of its linear function where it is needed: in one of the two modes.
    """
    flat, parts = ravel_pytree(b)  # one array: parts of b may depend on nothing that is differentiated

    def flattened(function: _Linear[_Unknown]) -> _Linear[Array]:
        return lambda v: ravel_pytree(function(parts(v)))[0]

    def solver(inverse: Callable[[_Linear[_Unknown]], _Linear[_Unknown]]) -> Callable[[_Linear[Array], Array], Array]:
        def solve(matvec: _Linear[Array], b: Array) -> Array:
            correction = flattened(inverse(lambda v: parts(matvec(ravel_pytree(v)[0]))))
            return lax.fori_loop(0, refinements, lambda _, v: v + correction(b - matvec(v)), correction(b))

        return solve

    return parts(lax.custom_linear_solve(flattened(linear), flat, solver(forward), solver(transposed)))
