"""The step of least squares within a trust region and a box."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.custom_batching import sequential_vmap

_SECULAR = 20  # Newton corrections of the damping; it takes 2 to 6
_PASSES = 4  # the most changes of the set of coordinates at a side, for each coordinate; the steps of fits need 0 to 2


class Step(NamedTuple):
    """A step z in scaled coordinates.

    Attributes:
        z: the step, (p,).
        fall: the predicted decrease of half the sum of squares, from the linearized residuals.
        damping: λ of the trust region; 0 where it does not limit the step.
    """

    z: Array
    fall: Array
    damping: Array


def bounded_step(A: Array, r: Array, radius: Array, low: Array, high: Array) -> Step:
    """The z that minimizes |r + Az| where |z| ≤ radius and low ≤ z ≤ high, with low < 0 < high.

    It is an active-set method: coordinates that meet a side are held there, one after the other, and released where the
    gradient points back inside. The objective decreases with every change, so that an unfinished search still yields a
    step. Without finite sides it is the step of Levenberg and Marquardt.
    """
    M, c = _triangle(A, r)

    def is_unfinished(state: _Active) -> Array:
        return ~state.done & (state.passes < _PASSES * M.shape[1])

    none = jnp.zeros(M.shape[1], jnp.int32)
    start = _Active(jnp.zeros_like(low), none, jnp.zeros_like(c[0]), none[0], jnp.zeros((), bool))
    end = lax.while_loop(is_unfinished, lambda state: _change(M, c, radius, low, high, state), start)
    along = M @ end.z
    return Step(end.z, -jnp.vdot(c, along) - jnp.vdot(along, along) / 2, end.damping)


class _Active(NamedTuple):
    """A search for the coordinates that the step holds at a side.

    Attributes:
        z: the step so far.
        side: for each coordinate −1 if it is held at its lower side, 1 at the upper one, otherwise 0.
        damping: λ of the last solve.
        passes: the number of solves.
        done: whether z is the minimizer.
    """

    z: Array
    side: Array
    damping: Array
    passes: Array
    done: Array


def _change(M: Array, c: Array, radius: Array, low: Array, high: Array, state: _Active) -> _Active:
    """Move toward the minimizer with the present coordinates held; hold or free one more."""
    z, side, *_ = state
    held = side != 0
    fixed = jnp.where(held, z, 0)
    rest = jnp.sqrt(jnp.maximum(radius**2 - jnp.vdot(fixed, fixed), (1e-8 * radius) ** 2))
    best, damping = _damped_step(jnp.where(held, 0, M), c + M @ fixed, rest)
    path = jnp.where(held, 0, best - z)
    end = jnp.where(path > 0, high, low)
    part = jnp.where(path == 0, jnp.inf, (end - z) / jnp.where(path == 0, 1, path))
    first = jnp.argmin(part)
    meets = part[first] < 1
    z = z + jnp.minimum(part[first], 1) * path
    z = jnp.where(meets, z.at[first].set(end[first]), z)
    pull = (M.T @ (M @ z + c) + damping * z) * side.astype(z.dtype)  # positive where a held one wants back
    free = jnp.argmax(pull)
    inwards = ~meets & (pull[free] > 8 * jnp.finfo(c.dtype).eps * jnp.linalg.norm(M[:, free]) * jnp.linalg.norm(c))
    side = jnp.where(meets, side.at[first].set(jnp.sign(path[first]).astype(side.dtype)), side)
    side = jnp.where(inwards, side.at[free].set(0), side)
    return _Active(z, side, damping, state.passes + 1, ~meets & ~inwards)


def _damped_step(A: Array, r: Array, radius: Array) -> tuple[Array, Array]:
    """The minimizer z of |r + Az| within |z| ≤ radius, the shortest of all, and its λ in (AᵀA + λ)z = −Aᵀr."""
    U, s, Vt = svd(A)
    known = above_rounding(s, A)
    g, s = jnp.where(known, U.T @ r, 0), jnp.where(known, s, 1)

    def correction(_: int, damping: Array) -> Array:
        p = s * g / (s * s + damping)
        length = jnp.linalg.norm(p)
        slope = jnp.sum(p * p / (s * s + damping))
        return damping + jnp.where(length > radius, length**2 * (length - radius) / (radius * slope), 0)

    damping = lax.fori_loop(0, _SECULAR, correction, jnp.zeros_like(s[0]))
    return -(Vt.T @ (s * g / (s * s + damping))), damping


def above_rounding(s: Array, A: Array) -> Array:
    """True for the singular values s of A above round-off."""
    return s > jnp.finfo(s.dtype).eps * max(A.shape) * s[0]


# XLA runs the decompositions of a batch on the threads that run a CPU's devices: where each core is a device, all of
# them wait and none is left to do the work. So they are computed one matrix after the other.


@sequential_vmap
def svd(A: Array) -> tuple[Array, Array, Array]:
    """The singular value decomposition, one matrix of a batch after the other, with as many values as columns."""
    U, s, Vt = jnp.linalg.svd(_tall(A), full_matrices=False)
    return U[: A.shape[0]], s, Vt


@sequential_vmap
def _triangle(A: Array, r: Array) -> tuple[Array, Array]:
    """R and Qᵀr of A = QR, one matrix of a batch after the other: |r + Az|² is |Qᵀr + Rz|² and a constant."""
    tall = _tall(A)
    Q, R = jnp.linalg.qr(tall)
    return R, Q[: A.shape[0]].T @ r


def _tall(A: Array) -> Array:
    """A with rows of zeros below where it has fewer rows than columns."""
    missing = max(0, A.shape[1] - A.shape[0])
    return jnp.concatenate([A, jnp.zeros((missing, A.shape[1]), A.dtype)])
