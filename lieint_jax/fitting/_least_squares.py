"""Least squares: Gauss–Newton, and Levenberg–Marquardt with a trust region; the covariance of the estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_batching import sequential_vmap
from jax.flatten_util import ravel_pytree

from lieint_jax.fitting._search import FLAT, NOWHERE, RUNNING, SHORTENINGS, STILL, STUCK, Carry, Method, where

_SECULAR = 20  # Newton corrections of the damping; it takes 2 to 6


class _Memory(NamedTuple):
    """The state of a least-squares search.

    Attributes:
        r: residuals.
        J: their Jacobian.
        D: the scales of the parameters.
        radius: the trust radius, a bound of |Dδ|; for Gauss–Newton, the fraction of its step that is taken.
    """

    r: Array
    J: Array
    D: Array
    radius: Array


def least_squares(residuals: Callable[[Array], tuple[Array, Array]], undamped: bool, tolerance: float) -> Method:
    """Minimise |r(x)|²/2.

    A step δ minimises |r + Jδ|² + λ|Dδ|², where λ keeps |Dδ| within the radius and D holds the largest norms of the
    columns of J so far. `undamped`, it is the step of Gauss–Newton, halved until the loss falls.

    Source: Moré 1978, Lecture Notes in Mathematics 630; here by singular values.
    """

    def look(x: Array) -> tuple[Array, Array, Array]:
        def twice(x: Array) -> tuple[Array, tuple[Array, Array]]:
            r, ok = residuals(x)
            return r, (r, ok)

        J, (r, ok) = jacobian(twice, x)
        return r, J, ok & jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))

    def first(x: Array) -> tuple[Array, _Memory, Array]:
        """Zeros: the first iteration takes a step of 0 and evaluates x, so that the simulation is compiled once."""
        r, J, _ = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(look, x))
        one = jnp.ones((), r.dtype)
        return jnp.inf * one, _Memory(r, J, jnp.zeros_like(J[0]), one), jnp.ones((), bool)

    def advance(carry: Carry) -> Carry:
        r, J, D, radius = carry.memory
        begun = jnp.isfinite(carry.loss)
        scale = jnp.where(D > 0, D, 1)
        newton, damped, damping = _steps(J / scale, r, radius)
        step, damping = (radius * newton, 0.0) if undamped else (damped, damping)
        x = carry.x + step / scale
        trial, J_trial, ok = look(x)
        loss = jnp.vdot(trial, trial) / 2
        fall = carry.loss - loss
        along = J @ (step / scale)
        predicted = jnp.vdot(along, along) / 2 + damping * jnp.vdot(step, step)
        better = ok & ((fall >= 1e-4 * predicted) | ~begun)
        grown = jnp.maximum(D, jnp.linalg.norm(J_trial, axis=0))
        length, size = jnp.linalg.norm(step), jnp.linalg.norm(scale * carry.x)
        if undamped:
            radius = jnp.where(better, jnp.minimum(1, 2 * radius), radius / 2)
        else:
            radius = jnp.where(better, _adapted(radius, length, fall, predicted, damping), length / 4)
            radius = jnp.where(begun, radius, jnp.linalg.norm(grown * jnp.maximum(jnp.abs(x), 1)))
        memory = where(better, _Memory(trial, J_trial, grown, radius), carry.memory)._replace(radius=radius)
        x, loss = where(better, (x, loss), (carry.x, carry.loss))
        small = jnp.maximum(tolerance, 8 * jnp.finfo(x.dtype).eps)
        cosine = _cosine(memory.J, memory.r)
        still = (jnp.abs(fall) <= small * carry.loss) & (predicted <= small * carry.loss)
        settled = (cosine <= jnp.sqrt(small)) & still
        there = jnp.linalg.norm(newton) <= small * size  # even the undamped step is negligible
        bad = jnp.where(better, 0, carry.bad + 1)
        stuck = (bad > SHORTENINGS) | (begun & (length <= jnp.finfo(x.dtype).eps * size))
        code = jnp.where(begun & ok & (settled | there), STILL, jnp.where(stuck, STUCK, RUNNING))
        code = jnp.where(jnp.isfinite(loss), jnp.where(cosine <= small, FLAT, code), NOWHERE)
        return Carry(x, loss, memory, code.astype(jnp.int32), bad, carry.failures + ~ok)

    return Method(first, advance)


def _adapted(radius: Array, length: Array, fall: Array, predicted: Array, damping: Array | float) -> Array:
    """The trust radius after an accepted step: by how much of the predicted fall of the loss came true."""
    well = (fall >= 0.75 * predicted) | (damping == 0)
    return jnp.where(fall < 0.25 * predicted, length / 2, jnp.where(well, 2 * length, radius))


def _steps(A: Array, r: Array, radius: Array) -> tuple[Array, Array, Array]:
    """The shortest minimiser δ of |r + Aδ|; the minimiser within |δ| ≤ radius, and its λ in (AᵀA + λ)δ = −Aᵀr."""
    U, s, Vt = _svd(A)
    known = _known(s, A)
    g, s = jnp.where(known, U.T @ r, 0), jnp.where(known, s, 1)

    def correction(_: int, damping: Array) -> Array:
        p = s * g / (s * s + damping)
        length = jnp.linalg.norm(p)
        slope = jnp.sum(p * p / (s * s + damping))
        return damping + jnp.where(length > radius, length**2 * (length - radius) / (radius * slope), 0)

    damping = lax.fori_loop(0, _SECULAR, correction, jnp.zeros_like(s[0]))
    return -(Vt.T @ (g / s)), -(Vt.T @ (s * g / (s * s + damping))), damping


def _known(s: Array, A: Array) -> Array:
    """True for the singular values of A above round-off."""
    return s > jnp.finfo(s.dtype).eps * max(A.shape) * s[0]


def _cosine(J: Array, r: Array) -> Array:
    """The largest cosine between the residuals and a column of their Jacobian; 0 where either vanishes."""
    size = jnp.linalg.norm(J, axis=0) * jnp.linalg.norm(r)
    return jnp.max(jnp.abs(J.T @ r) / jnp.where(size > 0, size, 1))


@sequential_vmap
def _svd(A: Array) -> tuple[Array, Array, Array]:
    """The singular value decomposition, one matrix of a batch at a time.

    XLA runs the SVDs of a batch on the threads that run a CPU's devices: where each core is a device, all of them wait
    and none is left to do the work.
    """
    missing = max(0, A.shape[1] - A.shape[0])
    U, s, Vt = jnp.linalg.svd(jnp.concatenate([A, jnp.zeros((missing, A.shape[1]), A.dtype)]), full_matrices=False)
    return U[: A.shape[0]], s, Vt


def jacobian(residuals: Callable[[Array], tuple[Array, Any]], x: Array) -> tuple[Array, Any]:
    """The Jacobian of the first result, and the second: in forward mode, which is cheaper for few parameters.

    Through `studies.observe` and `reversible`, which have a reverse mode of their own and no other, in reverse mode.
    """
    try:
        return jax.jacfwd(residuals, has_aux=True)(x)
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
    return jax.jacrev(residuals, has_aux=True)(x)


def slopes(inside: Callable[[Array], Any], x: Array) -> Array:
    """The derivative of the parameters, as one vector, with respect to the free x, (p, p)."""
    return jax.jacfwd(lambda x: ravel_pytree(inside(x))[0])(x)


def spread(J: Array, inside: Callable[[Array], Any], x: Array) -> Array:
    """The covariance B (JᵀJ)⁻¹ Bᵀ, with J the Jacobian with respect to the free x, B that of the parameters.

    A parameter that the residuals do not determine has an infinite variance, and its covariances are nan.
    """
    size = jnp.linalg.norm(J, axis=0)
    size = jnp.where(size > 0, size, 1)
    _, s, Vt = _svd(J / size)
    known = _known(s, J)
    B = slopes(inside, x)
    W = B @ (Vt / size).T  # a column for each singular value
    half = W * jnp.where(known, 1 / jnp.where(known, s, 1), 0)
    lost = jnp.sum(jnp.where(known, 0, W * W), axis=1) > jnp.finfo(s.dtype).eps * jnp.sum(W * W, axis=1)
    unknown = jnp.where(jnp.eye(lost.size, dtype=bool), jnp.inf, jnp.nan)
    return jnp.where(lost[:, None] | lost, unknown, half @ half.T)
