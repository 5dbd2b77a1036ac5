"""The place where a function of one variable changes its sign, enclosed to round-off."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

_MORE_THAN_BISECTION = 8  # evaluations: the most that interpolation may waste


class SignChange(NamedTuple):
    """Where a function changes its sign.

    Attributes:
        u: the better of the two ends of the last bracket.
        ends: the function at the lower and the upper end, (2,).
    """

    u: Array
    ends: Array


class _Bracket(NamedTuple):
    """Two points on both sides of a change of sign."""

    a: Array  # the last one evaluated
    b: Array  # the other; a where f is 0
    fa: Array
    fb: Array
    t: Array  # the next point is a + t(b − a), if the limits allow it
    n: Array  # the number of evaluations


def sign_change(f: Callable[[Array], Array], before: Array, after: Array) -> SignChange:
    """The u in [0, 1] at which f changes its sign: a root, a pole or a jump, see `is_root`.

    By inverse quadratic interpolation where that is safe, else by bisection (Chandrupatla's method), until the bracket
    is as narrow as the rounding of 1: 4 to 8 evaluations for smooth functions. Each point stays so near to the middle
    of the bracket that bisection can still finish within 60 evaluations (31 in float32), as in the ITP method.

    Args:
        f: a function of a scalar. It is not evaluated if the signs of f(0) and f(1) are equal.
        before, after: f(0) and f(1).

    Source: Chandrupatla 1997, Adv. Eng. Softw. 28; Oliveira & Takahashi 2020, ACM Trans. Math. Softw. 47.
    """
    changes = jnp.sign(before) != jnp.sign(after)
    secant = after / jnp.where(changes, after - before, 1)
    zero = jnp.zeros_like(before)
    start = _Bracket(zero + 1, zero, after, before, secant, jnp.zeros((), int))

    def is_open(s: _Bracket) -> Array:
        """Whether numbers are left between the points."""
        return changes & (jnp.abs(s.b - s.a) > jnp.finfo(s.a.dtype).eps)

    s = lax.while_loop(is_open, lambda s: _narrow(f, s), start)
    u = jnp.where(jnp.abs(s.fa) < jnp.abs(s.fb), s.a, s.b)
    return SignChange(u, jnp.where(s.a < s.b, jnp.stack([s.fa, s.fb]), jnp.stack([s.fb, s.fa])))


def is_root(ends: Array, around: Array, after: Array) -> Array:
    """Whether a function goes through 0 where it changes its sign.

    A bracket shrinks to a pole or a jump as well. At a root the function decreases with the bracket: at its `ends` it
    is at most half as large as at the points `around` it, at some distance. So the root is right to that distance.

    Args:
        ends: of `SignChange`.
        around: the function at two points, the first below and the second above the bracket.
        after: the function after the change.
    """
    sides = jnp.sign(around) * jnp.sign(after)
    return (sides[0] < 0) & (sides[1] > 0) & (2 * jnp.abs(ends) <= jnp.abs(around)).all()


def _narrow(f: Callable[[Array], Array], s: _Bracket) -> _Bracket:
    """The bracket after one evaluation."""
    x = s.a + _safe_fraction(s) * (s.b - s.a)
    fx = f(x)
    same = jnp.sign(fx) == jnp.sign(s.fa)
    c, fc = jnp.where(same, s.a, s.b), jnp.where(same, s.fa, s.fb)  # the point that the bracket loses
    b, fb = jnp.where(same, s.b, s.a), jnp.where(same, s.fb, s.fa)
    b, fb = jnp.where(fx == 0, x, b), jnp.where(fx == 0, fx, fb)
    xi, phi = (x - b) / (c - b), (fx - fb) / (fc - fb)
    safe = (phi * phi < xi) & ((1 - phi) ** 2 < 1 - xi)
    t = fx / (fb - fx) * fc / (fb - fc) + (c - x) / (b - x) * fx / (fc - fx) * fb / (fc - fb)
    return _Bracket(x, b, fx, fb, jnp.where(safe, t, 0.5), s.n + 1)


def _safe_fraction(s: _Bracket) -> Array:
    """t, moved to where bisection can still finish within the most evaluations."""
    info = jnp.finfo(s.t.dtype)
    least = info.eps / 2 / jnp.abs(s.b - s.a)
    room = jnp.exp2((info.nmant + _MORE_THAN_BISECTION - s.n).astype(s.t.dtype)) * least - 0.5
    off = jnp.clip(jnp.minimum(room, 0.5 - least), 0)
    return jnp.clip(s.t, 0.5 - off, 0.5 + off)
