"""Least squares: Gauss–Newton, and Levenberg–Marquardt with a trust region; the covariance of the estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.fitting._box import Box
from lieint_jax.fitting._search import (
    BEYOND,
    FLAT,
    HIDDEN,
    NOWHERE,
    RUNNING,
    SETTLED,
    SHORTENINGS,
    STILL,
    STUCK,
    Carry,
    Method,
    where,
)
from lieint_jax.fitting._trust_region import Step, above_rounding, bounded_step, svd

_FIRST = 0.1  # the first trust radius, over the size of the coordinates or of 1
_ROUNDING = 8  # units of round-off that are negligible


class _Memory(NamedTuple):
    """The state of a least-squares search.

    Attributes:
        r: residuals.
        J: their Jacobian.
        D: the scales of the coordinates.
        radius: the trust radius, a bound of |Dδ|; for Gauss–Newton, the fraction of its step that is tried.
        step: the step that is tried next, times D.
        newton: the length of the step of Gauss–Newton, times D.
        begin: the loss of the first guess.
        largest: the largest absolute values of the coordinates so far, (p,).
        excess: the step of Gauss–Newton that the loss does not show, over what is negligible, (p,), as in `_unseen`.
        polishes: whether that step is tried next, since all else has converged.
    """

    r: Array
    J: Array
    D: Array
    radius: Array
    step: Step
    newton: Array
    begin: Array
    largest: Array
    excess: Array
    polishes: Array


def least_squares(
    residuals: Callable[[Array], tuple[Array, Array]], box: Box, undamped: bool, tolerance: float
) -> Method:
    """Minimize |r(x)|²/2 inside a box.

    A step δ minimizes |r + Jδ| with |Dδ| within the radius and x + δ in the box, slightly inside its sides; D holds the
    largest norms of the columns of J so far. If `undamped`, δ is the Gauss–Newton step in the box, halved until the
    loss decreases. The search has converged when the Gauss–Newton step is negligible, or when the decrease of the loss
    is negligible compared with the loss or with the round-off of the first loss. Loss and |Dδ| are those of the largest
    residuals: what these hide of the Gauss–Newton step must be negligible for every coordinate (`_unseen`). Where it is
    not, that part is the next step, as long as it becomes shorter.

    Source: Moré 1978, Lecture Notes in Mathematics 630; here by singular values, and with a box.
    """

    def look(x: Array) -> tuple[Array, Array, Array]:
        def twice(x: Array) -> tuple[Array, tuple[Array, Array]]:
            r, ok = residuals(x)
            return r, (r, ok)

        J, (r, ok) = jacobian(twice, x)
        return r, J, ok & jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))

    def first(x: Array) -> tuple[Array, _Memory, Array]:
        """Zeros: the first iteration makes a step of 0 and evaluates x, so that the simulation is compiled once."""
        r, J, _ = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(look, x))
        if not r.size:
            raise ValueError("the loss returned no residuals: least squares needs at least one number")
        one, none = jnp.ones((), r.dtype), jnp.zeros_like(J[0])
        step, false = Step(none, 0 * one, 0 * one), jnp.zeros((), bool)
        memory = _Memory(r, J, none, one, step, one, 0 * one, none, none, false)
        return jnp.inf * one, memory, ~false

    def iterate(carry: Carry) -> Carry:
        r, J, D, radius, step, length, begin, largest, before, polishes = carry.memory
        begun = jnp.isfinite(carry.loss)
        small = jnp.maximum(tolerance, _ROUNDING * jnp.finfo(carry.x.dtype).eps)
        x = carry.x + step.z / _scale(D)
        trial, J_trial, ok = look(x)
        loss = jnp.vdot(trial, trial) / 2
        fall = carry.loss - loss
        lower = jnp.where(polishes, -fall <= small * carry.loss + _rounding(begin), fall >= 1e-4 * step.fall)
        better = ok & (lower | ~begun)
        grown = jnp.maximum(D, _column_norms(J_trial))
        fraction = jnp.where(better, jnp.minimum(1, 2 * radius), radius / 2)  # of the next step of Gauss–Newton
        adapted = fraction if undamped else _radius(radius, better, fall, step)
        opening = 1 if undamped else _FIRST * jnp.linalg.norm(grown * jnp.maximum(jnp.abs(x), 1))
        radius = jnp.where(polishes, radius, jnp.where(begun, adapted, opening))
        r, J, D = where(better, (trial, J_trial, grown), (r, J, D))
        x, loss = where(better, (x, jnp.minimum(loss, carry.loss)), (carry.x, carry.loss))
        begin, largest = jnp.where(begun, begin, loss), jnp.maximum(largest, jnp.abs(x))
        newton, ahead = _next_steps(box, undamped, x, r, J, D, radius)
        unseen, excess = _unseen(box, x, r, J, D, newton, loss, begin, largest, small)
        size = jnp.linalg.norm(D * x)
        memory = _Memory(r, J, D, radius, ahead, jnp.linalg.norm(newton.z), begin, largest, excess, polishes)
        still = begun & ok & (jnp.maximum(jnp.abs(fall), step.fall) <= small * loss)
        arrived = _stop_code(box, x, loss, memory, newton, still, small)
        arrived = jnp.where((arrived == RUNNING) & begun & ok & (length <= small * size), SETTLED, arrived)
        moves = (arrived != RUNNING) & jnp.any(excess > 1)
        hidden = moves & polishes & ~(better & (jnp.max(excess) < jnp.max(before)))
        arrived = jnp.where(moves, jnp.where(hidden, HIDDEN, RUNNING), arrived)
        memory = memory._replace(step=where(moves, unseen, ahead), polishes=moves)
        bad = jnp.where(better, 0, carry.bad + 1)
        minute = begun & (jnp.linalg.norm(step.z) <= jnp.finfo(x.dtype).eps * size)
        code = jnp.where((arrived == RUNNING) & ~moves & (minute | (bad > SHORTENINGS)), STUCK, arrived)
        code = jnp.where(jnp.isfinite(loss), code, NOWHERE)
        beyond = ok & ~begun & (jnp.isinf(loss) | (loss == 0) & jnp.any(r != 0))
        code = jnp.where(beyond, BEYOND, code)
        return Carry(x, loss, memory, code.astype(jnp.int32), bad, carry.failures + (~ok).astype(jnp.int32))

    return Method(first, iterate)


def _scale(D: Array) -> Array:
    return jnp.where(D > 0, D, 1)


def _column_norms(J: Array) -> Array:
    """The norms of the columns of J, even where their squares leave the range of floating-point numbers."""
    largest = jnp.finfo(J.dtype).maxexp - 2
    exponent = jnp.clip(jnp.frexp(jnp.max(jnp.abs(J), axis=0))[1], -largest, largest)
    unit = jnp.ldexp(jnp.ones((), J.dtype), exponent)  # powers of 2, which round nothing
    return unit * jnp.linalg.norm(J / unit, axis=0)


def _radius(radius: Array, better: Array, fall: Array, step: Step) -> Array:
    """The trust radius after a step, from the ratio of the actual to the predicted decrease of the loss."""
    length = jnp.linalg.norm(step.z)
    well = (fall >= 0.75 * step.fall) | (step.damping == 0)
    accepted = jnp.where(fall < 0.25 * step.fall, length / 2, jnp.where(well, 2 * length, radius))
    return jnp.where(better, accepted, length / 4)


def _stop_code(box: Box, x: Array, loss: Array, memory: _Memory, newton: Step, still: Array, small: Array) -> Array:
    """FLAT or STILL if x is a minimum in the box, otherwise RUNNING; `still`: the last step hardly changed the loss."""
    r, J = memory.r, memory.J
    room = jnp.where(J.T @ r > 0, x - jnp.asarray(box.low, x.dtype), jnp.asarray(box.high, x.dtype) - x)
    norm, size = jnp.linalg.norm(r), _column_norms(J)
    cosines = jnp.abs(J.T @ r) / jnp.where(size * norm > 0, size * norm, 1)
    cosine = jnp.max(cosines * jnp.minimum(1, room * size / jnp.where(norm > 0, norm, 1)))
    flat = (newton.fall <= jnp.maximum(small * loss, _rounding(memory.begin))) | (cosine <= small)
    return jnp.where(flat, FLAT, jnp.where(still & (cosine <= jnp.sqrt(small)), STILL, RUNNING))


def _rounding(begin: Array) -> Array:
    """The loss of residuals that are rounding errors of the first ones, whose loss is `begin`."""
    return (_ROUNDING * jnp.finfo(begin.dtype).eps) ** 2 * begin


def _unseen(
    box: Box,
    x: Array,
    r: Array,
    J: Array,
    D: Array,
    newton: Step,
    loss: Array,
    begin: Array,
    largest: Array,
    small: Array,
) -> tuple[Step, Array]:
    """The part of the Gauss–Newton step that tests of the loss and of |Dδ| neglect, and each coordinate's excess, (p,).

    It is the sum of the singular vectors of J, scaled by D, along which the loss falls by a negligible part of itself,
    or |Dδ| is a negligible part of |Dx|. Where some residuals weigh 10⁸ times as much as the others, these vectors may
    be long in coordinates that only the others determine. The excess is |δ| over what is negligible: the square root
    of the tolerance, since the loss is quadratic, of the coordinate or of the contributions of single residuals to the
    step, which cancel at a minimum; or the tolerance itself of the largest coordinate so far. Units of residuals and
    coordinates do not matter.
    """
    scale = _scale(D)
    low, high = (scale * side for side in box.reach(x))
    held = (newton.z <= low) | (newton.z >= high)
    A = jnp.where(held, 0, J / scale)
    rest = r + J @ jnp.where(held, newton.z / scale, 0)
    U, s, Vt = svd(A)
    along, floor = U.T @ rest, jnp.maximum(small * loss, _rounding(begin))
    known = above_rounding(s, A)
    neglected = (along**2 / 2 <= floor) | (jnp.abs(along) <= small * jnp.linalg.norm(D * x) * s)
    inverse = Vt.T * jnp.where(known & neglected, 1 / jnp.where(known, s, 1), 0)
    contributions = jnp.abs(inverse @ U.T) @ jnp.abs(rest)
    to_side = jnp.where(jnp.abs(newton.z * (J.T @ r)) <= floor * scale, newton.z, 0)
    z = jnp.where(held, to_side, -inverse @ along)
    negligible = jnp.maximum(jnp.sqrt(small) * jnp.maximum(scale * jnp.abs(x), contributions), small * scale * largest)
    negligible = jnp.where(held, jnp.sqrt(small) * scale * largest, negligible)
    excess = jnp.abs(z) / jnp.where(negligible > 0, negligible, 1)
    return Step(scale * box.shortened(x, z / scale), 0 * loss, 0 * loss), excess


def _next_steps(box: Box, undamped: bool, x: Array, r: Array, J: Array, D: Array, radius: Array) -> tuple[Step, Step]:
    """The step of Gauss–Newton in the box, and the one to try."""
    scale = _scale(D)
    low, high = (scale * side for side in box.reach(x))
    radii = jnp.stack([jnp.full_like(radius, jnp.inf), radius])
    both = jax.vmap(lambda radius: bounded_step(J / scale, r, radius, low, high))(radii)
    newton, damped = (Step(*(leaf[k] for leaf in both)) for k in range(2))
    if undamped:
        return newton, newton._replace(z=radius * newton.z, fall=radius * newton.fall)
    return newton, damped


def jacobian(residuals: Callable[[Array], tuple[Array, PyTree]], x: Array) -> tuple[Array, PyTree]:
    """The Jacobian of the first result, and the second result; in forward mode, which is faster for few parameters.

    Through `ReversibleAdjoint`, which supports reverse mode only, it is computed in reverse mode.
    """
    try:
        return jax.jacfwd(residuals, has_aux=True)(x)
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
    return jax.jacrev(residuals, has_aux=True)(x)


def spread(J: Array, B: Array, held: Array) -> tuple[Array, Array]:
    """The covariance B (JᵀJ)⁻¹ Bᵀ, and the rank of J; J is the Jacobian by coordinates, B that of the parameters.

    Coordinates that are `held` at a side of the box are treated as known. Parameters that depend on them have the
    variance nan; those that the residuals do not determine have an infinite variance, and covariances nan. A variance
    outside the range of floating-point numbers, such as 1e-50 in float32, is nan.
    """
    J = jnp.where(held, 0, J)
    size = _scale(_column_norms(J))
    _, s, Vt = svd(J / size)
    known = above_rounding(s, J)
    W = jnp.where(held, 0, B) @ (Vt / size).T  # a column for each singular value
    half = W * jnp.where(known, 1 / jnp.where(known, s, 1), 0)
    squares = jnp.square(W / _scale(jnp.max(jnp.abs(W), axis=1, keepdims=True)))
    lost = jnp.sum(jnp.where(known, 0, squares), axis=1) > jnp.finfo(s.dtype).eps * jnp.sum(squares, axis=1)
    unknown = jnp.where(jnp.eye(lost.size, dtype=bool), jnp.inf, jnp.nan)
    covariance = half @ half.T
    variance = jnp.diagonal(covariance)
    out_of_range = ~lost & (jnp.isinf(variance) | (variance == 0) & jnp.any(half != 0, axis=1))
    covariance = jnp.where(jnp.diag(out_of_range), jnp.nan, covariance)
    covariance = jnp.where(lost[:, None] | lost, unknown, covariance)
    at_side = jnp.any(held & (B != 0), axis=1)
    return jnp.where(at_side[:, None] | at_side, jnp.nan, covariance), jnp.sum(known)
