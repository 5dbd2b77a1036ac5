"""Logarithms and inverse hyperbolic functions."""

from lieint_jax.native.functions._double_double import Pair, choose, fast_two_sum, pair, root, two_product, two_sum
from lieint_jax.native.functions._value import LlvmValue, copy_sign, fma, polynomial, where
from lieint_jax.native.functions.coefficients import INF, LN2_42_BITS, LOG, LOG_FIFTH, NAN


def _mantissa(x: LlvmValue) -> tuple[LlvmValue, LlvmValue, LlvmValue]:
    """(m, k, e): x = m 2^k with √½ ≤ m < √2, for positive finite normal x; e = (k + 1024) 2⁵² as an integer."""
    bits = x.bits()
    exponent = (bits - 0x3FE6A09E667F3BCD + (1024 << 52)) & ~((1 << 52) - 1)
    m = (bits - exponent + (1024 << 52)).double()
    k = ((exponent >> 52) | (1075 << 52)).double() - (2.0**52 + 1024)
    return m, k, exponent


def normalize(x: LlvmValue) -> tuple[LlvmValue, LlvmValue]:
    """(x 2⁵⁴, −54) for subnormal x, else (x, 0)."""
    tiny = x < 2.0**-1022
    return where(tiny, x * 2.0**54, x), where(tiny, x.like(-54.0), 0.0)


def _log_limits(x: LlvmValue, log: LlvmValue) -> LlvmValue:
    """log x where x is positive and finite, else IEEE's values."""
    log = where(x < INF, log, x)
    return where(x.equals(0.0), -INF, where(x < 0.0, NAN, log))


def _log(x: LlvmValue) -> LlvmValue:
    """k ln 2 + f − f²/2 + s (f²/2 + s² P(s²)), f = m − 1, s = f/(2 + f); the first three terms without an error."""
    normal, shift = normalize(x)
    m, k, _ = _mantissa(normal)
    k = k + shift
    f = m - 1.0
    s = f / (m + 1.0)
    half = 0.5 * f
    parabola, parabola_low = two_product(half, f)
    square = s * s
    series = s * (parabola + square * polynomial(square, LOG))
    head, tail = fast_two_sum(k * LN2_42_BITS[0], f)
    head, rest = fast_two_sum(head, -parabola)
    log = head + (rest + (tail + fma(k, LN2_42_BITS[1], series - parabola_low)))
    return _log_limits(x, log)


def log_pair(x: Pair, k_more: LlvmValue | float = 0.0) -> Pair:
    """log x + k ln 2 as a pair with a relative error near 2⁻⁶⁶, for positive finite normal x."""
    m, k, exponent = _mantissa(x.high)
    power = ((2047 << 52) - exponent).double()
    low = where(x.high < 2.0**900, x.low * power, 0.0)
    f = fast_two_sum(m - 1.0, low)
    s = f / (2.0 + f)
    square = s * s
    fifth = square.high * polynomial(square.high, LOG_FIFTH)
    third = two_sum(m.like(2 / 3), fifth)
    series = square * s * Pair(third.high, third.low + 3.700743415417188e-17)
    log = Pair(s.high + s.high, s.low + s.low) + series
    k = k + k_more
    return Pair(k * LN2_42_BITS[0], k * LN2_42_BITS[1]) + log


def _log1p_pair(x: Pair) -> Pair:
    head, tail = two_sum(x.high, 1.0)
    return log_pair(fast_two_sum(head, tail + x.low))


def _log1p(x: LlvmValue) -> LlvmValue:
    head, tail = _log1p_pair(pair(x))
    return where(abs(x) < 2.0**-54, x, _log_limits(x + 1.0, head + tail))


def _asinh(x: LlvmValue) -> LlvmValue:
    """log(1 + a + a²/(1 + √(1 + a²))); log a + ln 2 for large a."""
    size = abs(x)
    large = size > 2.0**30
    a = where(large, 1.0, size)
    square = two_product(a, a)
    more = pair(a) + square / (1.0 + root(1.0 + square))
    head, tail = log_pair(choose(large, pair(size), 1.0 + more), where(large, a.like(1.0), 0.0))
    result = where(size < 2.0**-28, size, where(size < INF, head + tail, size))
    return copy_sign(result, x)


def _acosh(x: LlvmValue) -> LlvmValue:
    """log(1 + t + √(t (t + 2))), t = x − 1; log x + ln 2 for large x."""
    large = x > 2.0**30
    t = two_sum(where(large, 1.0, x), -1.0)
    more = t + root(t * (2.0 + t))
    head, tail = log_pair(choose(large, pair(x), 1.0 + more), where(large, x.like(1.0), 0.0))
    return where(x < 1.0, NAN, where(x < INF, head + tail, x))


def _atanh(x: LlvmValue) -> LlvmValue:
    """log(1 + 2a/(1 − a))/2, a = |x|."""
    size = abs(x)
    head, tail = _log1p_pair(pair(2.0 * size) / two_sum(x.like(1.0), -size))
    result = where(
        size < 2.0**-28, size, where(size < 1.0, 0.5 * (head + tail), where(size.equals(1.0), x.like(INF), NAN))
    )
    return copy_sign(result, x)


LOGARITHMS = {
    "log": _log, "log1p": _log1p, "asinh": _asinh, "acosh": _acosh, "atanh": _atanh,
}  # fmt: skip
