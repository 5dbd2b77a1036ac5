"""Sines and tangents, and their inverses."""

from lieint_jax.native.functions._angle_reduction import reduce_angle
from lieint_jax.native.functions._double_double import Pair, choose, fast_two_sum, pair, root, two_product
from lieint_jax.native.functions._value import LlvmValue, copy_sign, fma, polynomial, where
from lieint_jax.native.functions.coefficients import ATAN, COS, EXPONENT, HALF_PI, INF, SIGN_BIT, SIN


def _angle_parts(x: LlvmValue) -> tuple[Pair, Pair, LlvmValue]:
    """(sin r, cos r, k) of x = k π/2 + r, sin and cos as pairs that are not yet added."""
    r, minus_l, k = reduce_angle(x)
    square = r * r
    half = -0.5 * r
    cosine = fma(r, half, 1.0)
    rest = fma(r, half, 1.0 - cosine)  # 1 − r²/2 = cosine + rest
    minus_tail = fma(r * square, polynomial(square, tuple(-c for c in SIN)), minus_l * cosine)
    cosine_tail = fma(square * square, polynomial(square, COS), fma(r, minus_l, rest))
    return Pair(r, -minus_tail), Pair(cosine, cosine_tail), k


def _sincos(x: LlvmValue) -> tuple[LlvmValue, LlvmValue]:
    """(sin x, cos x)."""
    *parts, k = _angle_parts(x)
    sine, cosine = (head + tail for head, tail in parts)
    odd = (k << 63) < 0
    return where(odd, cosine, sine).flip((k & 2) << 62), where(odd, sine, cosine).flip(((k + 1) & 2) << 62)


def _tan(x: LlvmValue) -> LlvmValue:
    """sin r / cos r, or −cos r / sin r."""
    sine, cosine, k = _angle_parts(x)
    odd = (k << 63) < 0
    sine, cosine = fast_two_sum(*sine), fast_two_sum(*cosine)
    head, tail = choose(odd, cosine, sine) / choose(odd, sine, cosine)
    return where(x.equals(0.0), x, (head + tail).flip(k << 63))


def _angle(y: Pair, x: Pair, swapped: LlvmValue, negative: LlvmValue) -> LlvmValue:
    """The angle in [0, π] of the point (x, y), given 0 ≤ y ≤ x after swapping the two and dropping the sign of x.

    Above y = x/2, arctan(y/x) = π/4 − arctan((x − y)/(x + y)); the arctangent left is that of t ≤ 1/2.
    """
    folded = y.high > 0.5 * x.high
    below, lost = fast_two_sum(x.high, where(folded, y.high, 0.0))
    below_low = lost + where(folded, x.low + y.low, x.low)
    above = where(folded, x.high - y.high, y.high)
    above_low = where(folded, x.low - y.low, y.low)
    inverse = 1.0 / below
    t = above * inverse
    t_low = (fma(-t, below, above) + fma(-t, below_low, above_low)) * inverse
    eighths = where(folded, t.like(1.0), 0.0)  # of a turn
    eighths = where(swapped, 2.0 - eighths, eighths)
    eighths = where(negative, 4.0 - eighths, eighths)
    sign = where(folded ^ swapped ^ negative, t.constant("i64", SIGN_BIT), 0)
    t, t_low = t.flip(sign), t_low.flip(sign)
    base = eighths * (HALF_PI[0] / 2)
    base_low = fma(eighths, HALF_PI[1] / 2, fma(eighths, HALF_PI[0] / 2, -base))
    head, tail = fast_two_sum(base, t)
    square = t * t
    t_low = fma(-t_low, square, t_low)  # times 1/(1 + t²), the derivative, nearly
    return head + (tail + (base_low + fma(t * square, polynomial(square, ATAN), t_low)))


def _atan2(y: LlvmValue, x: LlvmValue) -> LlvmValue:
    """The angle of the point (x, y); the larger coordinate is scaled to [2, 4)."""
    tall, wide = abs(y), abs(x)
    swapped = tall > wide
    small, great = where(swapped, wide, tall), where(swapped, tall, wide)
    infinite = great.equals(INF)
    small = where(infinite, where(small.equals(INF), small.like(1.0), 0.0), small)
    great = where(infinite | great.equals(0.0), 1.0, great)
    exponent = great.bits() & EXPONENT
    scale = (EXPONENT - where(exponent.equals(0), 1 << 52, exponent)).double()
    angle = _angle(pair(small * scale), pair(great * scale), swapped, x.bits() < 0)
    return where(x.is_nan() | y.is_nan(), x + y, copy_sign(angle, y))


def _atan(x: LlvmValue) -> LlvmValue:
    size = abs(x)
    steep = size > 1.0
    size = where(size > 2.0**60, 2.0**60, size)  # arctan is π/2 there
    small, great = where(steep, 1.0, size), where(steep, size, 1.0)
    return copy_sign(_angle(pair(small), pair(great), steep, x.constant("i1", False)), x)


def _leg(x: LlvmValue) -> Pair:
    """√(1 − x²) as a pair."""
    square, square_low = two_product(x, x)
    head = 1.0 - square
    return root(fast_two_sum(head, ((1.0 - head) - square) - square_low))


def _arc(y: Pair, x: Pair, negative: LlvmValue) -> LlvmValue:
    """The angle of a point of the upper half of the unit circle."""
    swapped = y.high > x.high
    return _angle(choose(swapped, x, y), choose(swapped, y, x), swapped, negative)


ANGLES = {
    "sin": lambda x: _sincos(x)[0], "cos": lambda x: _sincos(x)[1], "sincos": _sincos, "tan": _tan,
    "asin": lambda x: copy_sign(_arc(pair(abs(x)), _leg(x), x.constant("i1", False)), x),
    "acos": lambda x: _arc(_leg(x), pair(abs(x)), x < 0.0), "atan": _atan, "atan2": _atan2,
}  # fmt: skip
