"""Exponentials, hyperbolic functions, powers and the cube root."""

import math

from lieint_jax.native.functions._double_double import Pair, choose, fast_two_sum, pair, two_product, two_sum
from lieint_jax.native.functions._logarithms import log_pair, normalize
from lieint_jax.native.functions._value import LlvmValue, copy_sign, fma, polynomial, unshift, where
from lieint_jax.native.functions.coefficients import CBRT, EXP, EXP_CUBIC, INF, LN2, NAN, ONE, SHIFT


def reduce_exponent(x: LlvmValue, low: LlvmValue | None = None) -> tuple[Pair, LlvmValue]:
    """(r, k): x = k ln 2 + r with |r| ≤ ½ ln 2, k in the low bits of an integer."""
    shifted = fma(x, 1 / math.log(2), SHIFT)
    k = unshift(shifted)
    first = fma(-k, LN2[0], x)
    r = fma(-k, LN2[1], first)
    rest = fma(-k, LN2[1], first - r)
    return Pair(r, rest) if low is None else two_sum(r, rest + low), shifted.bits()


def scale(x: LlvmValue, k: LlvmValue) -> LlvmValue:
    """x 2^k, rounded once, k in the low bits of an integer."""
    half = k >> 1
    return x * ((half << 52) + ONE).double() * (((k - half) << 52) + ONE).double()


def clamp(x: LlvmValue, least: float, greatest: float) -> LlvmValue:
    """The nearest number from `least` to `greatest`; NaN stays."""
    return where(x > greatest, greatest, where(x < least, least, x))


def _exp(x: LlvmValue) -> LlvmValue:
    (r, rest), k = reduce_exponent(clamp(x, -746.0, 710.0))
    head, tail = fast_two_sum(x.like(1.0), r)
    return scale(head + (tail + fma(r * r, polynomial(r, EXP), rest)), k)


def exp_fraction(r: Pair) -> Pair:
    """exp(r) − 1 for |r| ≤ ½ ln 2 and a little, with a relative error near 2⁻⁶²."""
    high, low = r
    square, square_low = two_product(0.5 * high, high)
    head, tail = fast_two_sum(high, square)
    cubic = fma(high * (square + square), polynomial(high, EXP_CUBIC), fma(low, high, low))
    return fast_two_sum(head, tail + (square_low + cubic))


def one_plus(x: Pair) -> Pair:
    """1 + x for |x| < 1."""
    head, tail = fast_two_sum(x.high.like(1.0), x.high)
    return fast_two_sum(head, tail + x.low)


def _exp_pair(x: LlvmValue) -> Pair:
    """exp(x) as a pair, for |x| ≤ 700."""
    r, k = reduce_exponent(x)
    power = ((k << 52) + ONE).double()
    head, tail = one_plus(exp_fraction(r))
    return Pair(head * power, tail * power)


def _expm1_pair(x: LlvmValue) -> Pair:
    """exp(x) − 1 as a pair, for |x| ≤ 60."""
    r, k = reduce_exponent(x)
    power = ((k << 52) + ONE).double()
    head, tail = exp_fraction(r)
    return two_sum(power, -1.0) + Pair(head * power, tail * power)


def _exp2(x: LlvmValue) -> LlvmValue:
    x = clamp(x, -1076.0, 1025.0)
    shifted = x + SHIFT
    r = pair(x - unshift(shifted)) * pair(x.like(LN2[0]), LN2[1])
    head, tail = one_plus(exp_fraction(r))
    return scale(head + tail, shifted.bits())


def _expm1(x: LlvmValue) -> LlvmValue:
    head, tail = _expm1_pair(clamp(x, -50.0, 50.0))
    return where(abs(x) < 2.0**-54, x, where(x > 50.0, _exp(x), head + tail))


def _half_exp(x: LlvmValue) -> LlvmValue:
    """exp(x)/2, which is finite a little longer than exp(x)."""
    r, k = reduce_exponent(clamp(x, -50.0, 712.0))
    head, tail = one_plus(exp_fraction(r))
    return scale(head + tail, k - 1)


def _sinh(x: LlvmValue) -> LlvmValue:
    """(E + E/(1 + E))/2, E = exp|x| − 1."""
    size = abs(x)
    minus_one = _expm1_pair(clamp(size, 0.0, 50.0))
    head, tail = minus_one + minus_one / (1.0 + minus_one)
    middle = 0.5 * head + 0.5 * tail
    return copy_sign(where(size < 2.0**-28, size, where(size > 50.0, _half_exp(size), middle)), x)


def _cosh(x: LlvmValue) -> LlvmValue:
    size = abs(x)
    power = _exp_pair(clamp(size, 0.0, 50.0))
    head, tail = power + 1.0 / power
    return where(size > 50.0, _half_exp(size), 0.5 * head + 0.5 * tail)


def _tanh(x: LlvmValue) -> LlvmValue:
    """E/(E + 2), E = exp(2|x|) − 1."""
    size = abs(x)
    minus_one = _expm1_pair(2.0 * clamp(size, 0.0, 25.0))
    head, tail = minus_one / (2.0 + minus_one)
    return copy_sign(where(size < 2.0**-28, size, head + tail), x)


def _logistic(x: LlvmValue) -> LlvmValue:
    """1/(1 + exp(−x)); for negative x, exp(x)/(1 + exp(x))."""
    power = _exp_pair(clamp(-abs(x), -700.0, 0.0))
    head, tail = choose(x < 0.0, power, pair(x.like(1.0))) / (1.0 + power)
    return where(x < -690.0, _exp(x), head + tail)


def _pow(x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """exp(y log|x|) with log as a pair; signs and limits as in C99, annex F.9.4.4."""
    size = abs(x)
    normal, shift = normalize(size)
    head, tail = log_pair(pair(normal), shift)
    head, tail = where(size < INF, head, size), where(size < INF, tail, 0.0)
    head = where(size.equals(0.0), -INF, head)
    product = y * head
    low = fma(y, head, -product) + y * tail
    inside = abs(product) < 800.0
    r, k = reduce_exponent(clamp(product, -800.0, 800.0), where(inside, low, 0.0))
    head, tail = one_plus(exp_fraction(r))
    result = scale(head + tail, k)

    length = abs(y)
    whole = length.equals((length + 2.0**52) - 2.0**52) | (length >= 2.0**52)
    half = 0.5 * length
    odd = whole & (half.differs((half + 2.0**52) - 2.0**52)) & (length < 2.0**53)
    result = result.flip(where(odd, x.sign(), 0))
    result = where((x < 0.0) & (x > -INF) & ~whole, NAN, result)
    result = where(x.is_nan() | y.is_nan(), x + y, result)
    return where(x.equals(1.0) | y.equals(0.0) | (x.equals(-1.0) & length.equals(INF)), 1.0, result)


def _cbrt(x: LlvmValue) -> LlvmValue:
    """x = m 8^j with 1 ≤ m < 8; two steps of Halley from a polynomial, and Newton's correction of an exact residual."""
    normal, shift = normalize(abs(x))
    bits = normal.bits()
    exponent = ((bits >> 52) | (1075 << 52)).double() - (2.0**52 + 1023)
    shifted = fma(exponent, 1 / 3, SHIFT - 1 / 3)
    j = unshift(shifted)
    m = (bits - ((shifted.bits() * 3) << 52)).double()
    root = polynomial(m, CBRT)
    for _ in range(2):
        cube = root * root * root
        root = root * fma(m, 2.0, cube) / fma(cube, 2.0, m)
    square, square_low = two_product(root, root)
    rest = fma(-square, root, m) - square_low * root
    cube_root = root + rest / (3.0 * square)
    power = ((j + shift / 3.0 + SHIFT).bits() << 52) + ONE
    result = copy_sign(cube_root * power.double(), x)
    return where((abs(x) < INF) & x.differs(0.0), result, x)


EXPONENTIALS = {
    "exp": _exp, "exp2": _exp2, "expm1": _expm1, "sinh": _sinh, "cosh": _cosh, "tanh": _tanh, "logistic": _logistic,
}  # fmt: skip
POWERS = {"pow": _pow, "cbrt": _cbrt}
