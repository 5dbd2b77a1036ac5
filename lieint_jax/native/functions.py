"""Elementary functions as vector code, within 1 ulp, with the same bits on every machine that has FMA.

`FUNCTIONS[name](builder, *args)` emits a call of an internal LLVM function, which the module gets once per name and
number of lanes; LLVM inlines it. Arguments are `double`, `float` or vectors of them; floats are computed as doubles.
All lanes run the same instructions, without tables; sin, cos and tan have a branch and a table for |x| > 2²⁴.

Coefficients are those of `mpmath.chebyfit` of the functions named in `tests/core/test_native_functions.py`, which
computes them again. Reductions follow Cody & Waite, *Software Manual for the Elementary Functions*, and Muller,
*Elementary Functions*, 3rd ed., chapters 10 and 11; pairs are double-doubles.
"""

import math
from collections.abc import Callable

from llvmlite import ir

from lieint_jax.native._number import (
    BIT,
    DOUBLE,
    INT,
    Llvm,
    Number,
    Pair,
    absolute,
    add,
    divide,
    fast_two_sum,
    fma,
    multiply,
    polynomial,
    root,
    two_product,
    two_sum,
    where,
    with_element,
)

SIN = (
    -0.16666666666666666, 0.008333333333333331, -0.00019841269841265065, 2.7557319219339167e-06,
    -2.5052106232447578e-08, 1.6058531618986147e-10, -7.586697117706918e-13,
)  # fmt: skip
COS = (
    0.041666666666666664, -0.0013888888888887398, 2.480158729876569e-05, -2.7557317271729793e-07, 2.08761462684032e-09,
    -1.1382632425521717e-11,
)  # fmt: skip
EXP = (
    0.5, 0.1666666666666667, 0.04166666666666667, 0.008333333333326141, 0.0013888888888883752, 0.00019841269874800493,
    2.4801587325533363e-05, 2.7557255425746435e-06, 2.7557273661348637e-07, 2.510520637395701e-08,
    2.0914679376583935e-09,
)  # fmt: skip
EXP_CUBIC = (
    0.16666666666666666, 0.04166666666666667, 0.008333333333333333, 0.0013888888888883752, 0.00019841269841266418,
    2.4801587325533363e-05, 2.7557319239947517e-06, 2.7557273661348637e-07, 2.5052078014485868e-08,
    2.0914679376583935e-09, 1.6084322823993442e-10,
)  # fmt: skip
LOG = (
    0.666666666666667, 0.39999999999899505, 0.28571428625975487, 0.2222221113479508, 0.18182889125261723,
    0.15331721600556042, 0.14616449685043406,
)  # fmt: skip
LOG_FIFTH = (
    0.4, 0.28571428571429364, 0.22222222221656232, 0.18181818335314404, 0.15384594970895457, 0.13334804238225345,
    0.11706248540922386, 0.11723051028097753,
)  # fmt: skip
ATAN = (
    -0.3333333333333333, 0.19999999999999488, -0.14285714285599188, 0.11111111100917376, -0.09090908620322523,
    0.07692294712540285, -0.06666435677235948, 0.05879578429582425, -0.05240099507994713, 0.04628024868570153,
    -0.03806653672057366, 0.025006503566489507, -0.009215792047089858,
)  # fmt: skip
CBRT = (0.6538962985569791, 0.4121814779629245, -0.06797280035500547, 0.0069891694835587225, -0.0002882199346276574)

INF, NAN = math.inf, math.nan
HALF_PI = (1.5707963267948966, 6.123233995736766e-17)
HALF_PI_29_BITS = (6.12323399409214e-17, 1.6446256936324258e-26)  # the second of these, cut to 29 bits, and the rest
LN2 = (0.6931471805599453, 2.3190468138462996e-17)
LN2_42_BITS = (0.6931471805598903, 5.497923018708371e-14)  # integers to 2¹¹ times the first are exact
LARGE_ANGLE = 2.0**24
_ROUND = 1.5 * 2**52  # x + this: the low bits are those of round(x)
_ONE, _EXPONENT, _SIGN_BIT = 1023 << 52, 0x7FF << 52, 1 << 63


def _round(shifted: Number) -> Number:
    """The integer k of k + 1.5·2⁵²."""
    return shifted - _ROUND


def _copy_sign(magnitude: Number, sign: Number) -> Number:
    """The magnitude, not negative, with the sign of another number."""
    return (magnitude.bits() | sign.sign()).double()


def _choose(condition: Number, yes: Pair, no: Pair) -> Pair:
    return where(condition, yes[0], no[0]), where(condition, yes[1], no[1])


# Angles


def _reduce(x: Number) -> tuple[Number, Number, Number]:
    """(r, −l, k): x = k π/2 + r + l, |r| ≤ π/4 and a little, k in the low bits of an integer.

    Cody and Waite with FMA (Li, Boldo & Daumas, IEEE Trans. Comp. 60, 2011): x − kP₁ is exact. P₂ has 29 bits, thus
    k P₂ is exact for |k| ≤ 2²⁴, and with it the error of the next difference. The least |r| there is 2^−60.5, and the
    error of r + l 2^−113.
    """
    shifted = fma(x, 2 / math.pi, _ROUND)
    k = _round(shifted)
    first = fma(-k, HALF_PI[0], x)
    head = fma(-k, HALF_PI_29_BITS[0], first)
    tail = fma(k, HALF_PI_29_BITS[1], fma(k, HALF_PI_29_BITS[0], head - first))
    r = head - tail
    reduced = r, tail - (head - r), shifted.bits()

    builder = x.builder
    lanes = getattr(x.value.type, "count", 1)
    large = absolute(x) > LARGE_ANGLE
    some = builder.icmp_signed("!=", builder.bitcast(large.value, ir.IntType(lanes)), ir.IntType(lanes)(0))
    before = builder.block
    with builder.if_then(some, likely=False):
        again = _call("reduce_large", _reduce_large, (x, *reduced), "noinline")
        after = builder.block
    joined = []
    for first, second in zip(reduced, again, strict=True):
        phi = builder.phi(first.value.type)
        phi.add_incoming(first.value, before)
        phi.add_incoming(second.value, after)
        joined.append(Number(builder, phi))
    r, minus_l, k = joined
    return r, minus_l, k


def _reduce_large(x: Number, *reduced: Number) -> tuple[Number, ...]:
    """(r, −l, k) with the lanes of finite |x| > 2²⁴ reduced again, one by one."""
    builder, type_ = x.builder, x.value.type
    large = (absolute(x) > LARGE_ANGLE) & (absolute(x) < INF)
    if not isinstance(type_, ir.VectorType):
        lanes = _call("payne_hanek", _payne_hanek, (x,), "noinline")
        return tuple(where(large, new, old) for new, old in zip(lanes, reduced, strict=True))
    values: list[Llvm] = [number.value for number in reduced]
    for index in map(ir.IntType(32), range(type_.count)):
        lane = Number(builder, builder.extract_element(x.value, index))
        for part, number in enumerate(_call("payne_hanek", _payne_hanek, (lane,), "noinline")):
            values[part] = builder.insert_element(values[part], number.value, index)
    return tuple(where(large, Number(builder, new), old) for new, old in zip(values, reduced, strict=True))


def _two_over_pi(bits: int) -> int:
    """⌊2/π · 2^bits⌋, by Machin's formula in integers."""
    guard = bits + 64

    def arctan_inverse(n: int) -> int:
        term = total = (1 << guard) // n
        divisor, sign = 1, 1
        while term:
            term //= n * n
            divisor, sign = divisor + 2, -sign
            total += sign * (term // divisor)
        return total

    pi = 16 * arctan_inverse(5) - 4 * arctan_inverse(239)
    return (1 << (guard + bits + 1)) // pi


_WIDE = ir.IntType(192)
_PADDING = 32  # zeros before the bits of 2/π, so that the window of the smallest large angle begins at a byte


def _payne_hanek(x: Number) -> tuple[Number, Number, Number]:
    """(r, −l, k) of `_reduce` for one double |x| > 2²⁴.

    x = m 2^E with an integer m. Of the bits of 2/π, those that contribute multiples of 4 to x · 2/π are left out; the
    next 192 times m, modulo 2¹⁹², are x · 2/π modulo 4 with an error below 2⁻¹³⁰ (Muller, section 11.4).
    """
    builder, module = x.builder, x.builder.module
    bits = x.bits().value
    exponent = builder.and_(builder.lshr(bits, INT(52)), INT(0x7FF))
    mantissa = builder.or_(builder.and_(bits, INT((1 << 52) - 1)), INT(1 << 52))
    first = builder.add(exponent, INT(_PADDING - 1075 - 2))  # bit of the table with which the window begins
    last = 2046 + _PADDING - 1075 - 2
    first = builder.select(builder.icmp_signed(">", first, INT(0)), first, INT(0))  # other lanes have small angles
    first = builder.select(builder.icmp_signed("<", first, INT(last)), first, INT(last))  # or infinite ones

    # The table lies in memory from its last byte to its first: a little-endian load has its bits in order.
    size = last // 8 + 24
    table = _two_over_pi(8 * size - _PADDING).to_bytes(size, "little")
    data = ir.Constant(ir.ArrayType(ir.IntType(8), size), bytearray(table))
    stored: Llvm = ir.GlobalVariable(module, data.type, "lieint.two_over_pi")
    stored.linkage, stored.global_constant, stored.initializer = "internal", True, data
    offset = builder.sub(INT(size - 24), builder.lshr(first, INT(3)))
    address = builder.gep(stored, [INT(0), offset])
    words = []
    for word in range(3):
        place = builder.gep(address, [INT(8 * word)], source_etype=ir.IntType(8))
        loaded = builder.load(builder.bitcast(place, INT.as_pointer()), typ=INT, align=1)
        words.append(builder.shl(builder.zext(loaded, _WIDE), _WIDE(64 * word)))
    window = builder.or_(words[0], builder.or_(words[1], words[2]))
    factor = builder.shl(mantissa, builder.and_(first, INT(7)))
    product = builder.mul(builder.zext(factor, _WIDE), window)

    quadrant = builder.trunc(builder.lshr(builder.add(product, _WIDE(1 << 189)), _WIDE(190)), INT)
    fraction = builder.shl(product, _WIDE(2))  # of a quadrant, as a signed number
    below = builder.icmp_signed("<", fraction, _WIDE(0))
    magnitude = builder.select(below, builder.neg(fraction), fraction)
    count = module.declare_intrinsic("llvm.ctlz", [_WIDE], ir.FunctionType(_WIDE, [_WIDE, BIT]))
    zeros = builder.call(count, [magnitude, BIT(1)])
    magnitude = builder.shl(magnitude, zeros)
    leading = [Number(builder, builder.trunc(builder.lshr(magnitude, _WIDE(192 - n)), INT)) for n in (53, 106)]
    high, low = (
        Number(builder, builder.sitofp((part & ((1 << 53) - 1)).value, DOUBLE)) * 2.0**-n
        for part, n in zip(leading, (53, 106), strict=True)
    )
    head, tail = multiply((high, low), (high.like(HALF_PI[0]), high.like(HALF_PI[1])))
    shift = Number(builder, builder.trunc(zeros, INT))
    scale = ((shift.like(1023) - shift) << 52).double()
    negative = Number(builder, builder.icmp_signed("<", bits, INT(0)))
    sign = where(negative ^ Number(builder, below), shift.like(_SIGN_BIT), 0)
    head, tail = ((part * scale).flip(sign) for part in (head, tail))
    k = where(negative, 0 - Number(builder, quadrant), Number(builder, quadrant))
    return head, -tail, k


def _angle_parts(x: Number) -> tuple[Pair, Pair, Number]:
    """(sin r, cos r, k) of x = k π/2 + r, sin and cos as pairs that are not yet added."""
    r, minus_l, k = _reduce(x)
    square = r * r
    half = -0.5 * r
    cosine = fma(r, half, 1.0)
    rest = fma(r, half, 1.0 - cosine)  # 1 − r²/2 = cosine + rest
    minus_tail = fma(r * square, polynomial(square, tuple(-c for c in SIN)), minus_l * cosine)
    cosine_tail = fma(square * square, polynomial(square, COS), fma(r, minus_l, rest))
    return (r, -minus_tail), (cosine, cosine_tail), k


def _sincos(x: Number) -> Pair:
    """(sin x, cos x)."""
    sine, cosine, k = _angle_parts(x)
    sine, cosine = sine[0] + sine[1], cosine[0] + cosine[1]
    odd = (k << 63) < 0
    return (
        where(odd, cosine, sine).flip((k & 2) << 62),
        where(odd, sine, cosine).flip(((k + 1) & 2) << 62),
    )


def _sin(x: Number) -> Number:
    return _sincos(x)[0]


def _cos(x: Number) -> Number:
    return _sincos(x)[1]


def _tan(x: Number) -> Number:
    """sin r / cos r, or −cos r / sin r."""
    sine, cosine, k = _angle_parts(x)
    odd = (k << 63) < 0
    sine, cosine = fast_two_sum(*sine), fast_two_sum(*cosine)
    above, below = (_choose(odd, cosine, sine), _choose(odd, sine, cosine))
    head, tail = divide(above, below)
    return where(x.equals(0.0), x, (head + tail).flip(k << 63))


def _angle(y: Pair, x: Pair, swapped: Number, negative: Number) -> Number:
    """The angle in [0, π] of the point (x, y), given 0 ≤ y ≤ x after swapping the two and dropping the sign of x.

    Above y = x/2, arctan(y/x) = π/4 − arctan((x − y)/(x + y)); the arctangent left is that of t ≤ 1/2.
    """
    folded = y[0] > 0.5 * x[0]
    below, lost = fast_two_sum(x[0], where(folded, y[0], 0.0))
    below_low = lost + where(folded, x[1] + y[1], x[1])
    above = where(folded, x[0] - y[0], y[0])
    above_low = where(folded, x[1] - y[1], y[1])
    inverse = 1.0 / below
    t = above * inverse
    t_low = (fma(-t, below, above) + fma(-t, below_low, above_low)) * inverse
    eighths = where(folded, t.like(1.0), 0.0)  # of a turn
    eighths = where(swapped, 2.0 - eighths, eighths)
    eighths = where(negative, 4.0 - eighths, eighths)
    sign = where(folded ^ swapped ^ negative, t.bits().like(_SIGN_BIT), 0)
    t, t_low = t.flip(sign), t_low.flip(sign)
    quarter_pi = (0.5 * HALF_PI[0], 0.5 * HALF_PI[1])
    base = eighths * quarter_pi[0]
    base_low = fma(eighths, quarter_pi[1], fma(eighths, quarter_pi[0], -base))
    head, tail = fast_two_sum(base, t)
    square = t * t
    t_low = fma(-t_low, square, t_low)  # times 1/(1 + t²), the derivative, nearly
    return head + (tail + (base_low + fma(t * square, polynomial(square, ATAN), t_low)))


def _atan2(y: Number, x: Number) -> Number:
    """The angle of the point (x, y); the larger coordinate is scaled to [2, 4)."""
    tall, wide = absolute(y), absolute(x)
    swapped = tall > wide
    small, great = where(swapped, wide, tall), where(swapped, tall, wide)
    infinite = great.equals(INF)
    small = where(infinite, where(small.equals(INF), small.like(1.0), 0.0), small)
    great = where(infinite | great.equals(0.0), 1.0, great)
    exponent = great.bits() & _EXPONENT
    scale = (_EXPONENT - where(exponent.equals(0), 1 << 52, exponent)).double()
    zero = y.like(0.0)
    angle = _angle((small * scale, zero), (great * scale, zero), swapped, x.bits() < 0)
    return where(x.compare("!=", x) | y.compare("!=", y), x + y, _copy_sign(angle, y))


def _atan(x: Number) -> Number:
    size = absolute(x)
    steep = size > 1.0
    one, zero = x.like(1.0), x.like(0.0)
    size = where(size > 2.0**60, 2.0**60, size)  # arctan is π/2 there
    small, great = where(steep, one, size), where(steep, size, one)
    return _copy_sign(_angle((small, zero), (great, zero), steep, _no_lane(x)), x)


def _no_lane(x: Number) -> Number:
    return Number(x.builder, ir.Constant(with_element(x.value.type, BIT), None))


def _leg(x: Number) -> Pair:
    """√(1 − x²) as a pair."""
    square, square_low = two_product(x, x)
    head = 1.0 - square
    return root(fast_two_sum(head, ((1.0 - head) - square) - square_low))


def _arc(y: Pair, x: Pair, negative: Number) -> Number:
    """The angle of a point of the upper half of the unit circle."""
    swapped = y[0] > x[0]
    return _angle(_choose(swapped, x, y), _choose(swapped, y, x), swapped, negative)


def _asin(x: Number) -> Number:
    return _copy_sign(_arc((absolute(x), x.like(0.0)), _leg(x), _no_lane(x)), x)


def _acos(x: Number) -> Number:
    return _arc(_leg(x), (absolute(x), x.like(0.0)), x < 0.0)


# Exponentials


def _exponent(x: Number, low: Number | None = None) -> tuple[Pair, Number]:
    """(r, k): x = k ln 2 + r with |r| ≤ ½ ln 2, k in the low bits of an integer."""
    shifted = fma(x, 1 / math.log(2), _ROUND)
    k = _round(shifted)
    first = fma(-k, LN2[0], x)
    r = fma(-k, LN2[1], first)
    rest = fma(-k, LN2[1], first - r)
    return (r, rest) if low is None else two_sum(r, rest + low), shifted.bits()


def _scale(x: Number, k: Number) -> Number:
    """x 2^k, rounded once, k in the low bits of an integer."""
    half = k >> 1
    return x * ((half << 52) + _ONE).double() * (((k - half) << 52) + _ONE).double()


def _clamp(x: Number, least: float, greatest: float) -> Number:
    """NaN stays."""
    return where(x > greatest, greatest, where(x < least, least, x))


def _exp(x: Number) -> Number:
    (r, rest), k = _exponent(_clamp(x, -746.0, 710.0))
    head, tail = fast_two_sum(x.like(1.0), r)
    return _scale(head + (tail + fma(r * r, polynomial(r, EXP), rest)), k)


def _exp_fraction(r: Pair) -> Pair:
    """exp(r) − 1 for |r| ≤ ½ ln 2 and a little, with a relative error near 2⁻⁶²."""
    half = 0.5 * r[0]
    square, square_low = two_product(half, r[0])
    head, tail = fast_two_sum(r[0], square)
    cubic = fma(r[0] * (square + square), polynomial(r[0], EXP_CUBIC), fma(r[1], r[0], r[1]))
    return fast_two_sum(head, tail + (square_low + cubic))


def _one_plus(x: Pair) -> Pair:
    head, tail = fast_two_sum(x[0].like(1.0), x[0])
    return fast_two_sum(head, tail + x[1])


def _exp_pair(x: Number) -> Pair:
    """exp(x) as a pair, for |x| ≤ 700."""
    r, k = _exponent(x)
    power = ((k << 52) + _ONE).double()
    head, tail = _one_plus(_exp_fraction(r))
    return head * power, tail * power


def _expm1_pair(x: Number) -> Pair:
    """exp(x) − 1 as a pair, for |x| ≤ 60."""
    r, k = _exponent(x)
    power = ((k << 52) + _ONE).double()
    head, tail = _exp_fraction(r)
    return add(two_sum(power, -1.0), (head * power, tail * power))


def _exp2(x: Number) -> Number:
    x = _clamp(x, -1076.0, 1025.0)
    shifted = x + _ROUND
    r = multiply((x - _round(shifted), x.like(0.0)), (x.like(LN2[0]), x.like(LN2[1])))
    head, tail = _one_plus(_exp_fraction(r))
    return _scale(head + tail, shifted.bits())


def _expm1(x: Number) -> Number:
    head, tail = _expm1_pair(_clamp(x, -50.0, 50.0))
    return where(absolute(x) < 2.0**-54, x, where(x > 50.0, _exp(x), head + tail))


def _half_exp(x: Number) -> Number:
    """exp(x)/2, which is finite a little longer than exp(x)."""
    r, k = _exponent(_clamp(x, -50.0, 712.0))
    head, tail = _one_plus(_exp_fraction(r))
    return _scale(head + tail, k - 1)


def _sinh(x: Number) -> Number:
    """(E + E/(1 + E))/2, E = exp|x| − 1."""
    size = absolute(x)
    minus_one = _expm1_pair(_clamp(size, 0.0, 50.0))
    head, tail = add(minus_one, divide(minus_one, _one_plus_any(minus_one)))
    middle = 0.5 * head + 0.5 * tail
    return _copy_sign(where(size < 2.0**-28, size, where(size > 50.0, _half_exp(size), middle)), x)


def _one_plus_any(x: Pair) -> Pair:
    return add((x[0].like(1.0), x[0].like(0.0)), x)


def _cosh(x: Number) -> Number:
    size = absolute(x)
    power = _exp_pair(_clamp(size, 0.0, 50.0))
    head, tail = add(power, divide((size.like(1.0), size.like(0.0)), power))
    return where(size > 50.0, _half_exp(size), 0.5 * head + 0.5 * tail)


def _tanh(x: Number) -> Number:
    """E/(E + 2), E = exp(2|x|) − 1."""
    size = absolute(x)
    minus_one = _expm1_pair(2.0 * _clamp(size, 0.0, 25.0))
    head, tail = divide(minus_one, add((size.like(2.0), size.like(0.0)), minus_one))
    return _copy_sign(where(size < 2.0**-28, size, head + tail), x)


def _logistic(x: Number) -> Number:
    """1/(1 + exp(−x)); for negative x, exp(x)/(1 + exp(x))."""
    power = _exp_pair(_clamp(-absolute(x), -700.0, 0.0))
    one = (x.like(1.0), x.like(0.0))
    head, tail = divide(_choose(x < 0.0, power, one), add(one, power))
    return where(x < -690.0, _exp(x), head + tail)


# Logarithms


def _mantissa(x: Number) -> tuple[Number, Number, Number]:
    """(m, k, e): x = m 2^k with √½ ≤ m < √2, for positive finite normal x; e = (k + 1024) 2⁵² as an integer."""
    bits = x.bits()
    exponent = (bits - 0x3FE6A09E667F3BCD + (1024 << 52)) & ~((1 << 52) - 1)
    m = (bits - exponent + (1024 << 52)).double()
    k = ((exponent >> 52) | (1075 << 52)).double() - (2.0**52 + 1024)
    return m, k, exponent


def _normal(x: Number) -> tuple[Number, Number]:
    """(x 2⁵⁴, −54) for subnormal x, else (x, 0)."""
    tiny = x < 2.0**-1022
    return where(tiny, x * 2.0**54, x), where(tiny, x.like(-54.0), 0.0)


def _log_limits(x: Number, log: Number) -> Number:
    """log x where x is positive and finite, else IEEE's values."""
    log = where(x < INF, log, x)
    return where(x.equals(0.0), -INF, where(x < 0.0, NAN, log))


def _log(x: Number) -> Number:
    """k ln 2 + f − f²/2 + s (f²/2 + s² P(s²)), f = m − 1, s = f/(2 + f); the first three terms without an error."""
    normal, shift = _normal(x)
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


def _log_pair(x: Pair, k_more: Number | float = 0.0) -> Pair:
    """log x + k ln 2 as a pair with a relative error near 2⁻⁶⁶, for positive finite normal x."""
    m, k, exponent = _mantissa(x[0])
    power = ((2047 << 52) - exponent).double()
    low = where(x[0] < 2.0**900, x[1] * power, 0.0)
    f = fast_two_sum(m - 1.0, low)
    zero = f[0].like(0.0)
    s = divide(f, add((zero + 2.0, zero), f))
    square = multiply(s, s)
    fifth = square[0] * polynomial(square[0], LOG_FIFTH)
    third = two_sum(f[0].like(2 / 3), fifth)
    series = multiply(multiply(square, s), (third[0], third[1] + 3.700743415417188e-17))
    log = add((s[0] + s[0], s[1] + s[1]), series)
    k = k + k_more
    return add((k * LN2_42_BITS[0], k * LN2_42_BITS[1]), log)


def _log1p_pair(x: Pair) -> Pair:
    head, tail = two_sum(x[0], 1.0)
    return _log_pair(fast_two_sum(head, tail + x[1]))


def _log1p(x: Number) -> Number:
    head, tail = _log1p_pair((x, x.like(0.0)))
    return where(absolute(x) < 2.0**-54, x, _log_limits(x + 1.0, head + tail))


def _asinh(x: Number) -> Number:
    """log(1 + a + a²/(1 + √(1 + a²))); log a + ln 2 for large a."""
    size = absolute(x)
    large = size > 2.0**30
    a = where(large, 1.0, size)
    zero = a.like(0.0)
    square = two_product(a, a)
    hypotenuse = root(_one_plus_any(square))
    more = add((a, zero), divide(square, _one_plus_any(hypotenuse)))
    one_more = add((a.like(1.0), zero), more)
    argument = where(large, size, one_more[0]), where(large, 0.0, one_more[1])
    head, tail = _log_pair(argument, where(large, a.like(1.0), 0.0))
    result = where(size < 2.0**-28, size, where(size < INF, head + tail, size))
    return _copy_sign(result, x)


def _acosh(x: Number) -> Number:
    """log(1 + t + √(t (t + 2))), t = x − 1; log x + ln 2 for large x."""
    large = x > 2.0**30
    zero = x.like(0.0)
    t = two_sum(where(large, 1.0, x), -1.0)
    more = add(t, root(multiply(t, add((zero + 2.0, zero), t))))
    one_more = add((zero + 1.0, zero), more)
    argument = where(large, x, one_more[0]), where(large, 0.0, one_more[1])
    head, tail = _log_pair(argument, where(large, x.like(1.0), 0.0))
    return where(x < 1.0, NAN, where(x < INF, head + tail, x))


def _atanh(x: Number) -> Number:
    """log(1 + 2a/(1 − a))/2, a = |x|."""
    size = absolute(x)
    zero = x.like(0.0)
    head, tail = _log1p_pair(divide((2.0 * size, zero), two_sum(zero + 1.0, -size)))
    result = where(
        size < 2.0**-28, size, where(size < 1.0, 0.5 * (head + tail), where(size.equals(1.0), x.like(INF), NAN))
    )
    return _copy_sign(result, x)


# Powers


def _pow(x: Number, y: Number) -> Number:
    """exp(y log|x|) with log as a pair; signs and limits as in C99, annex F.9.4.4."""
    size = absolute(x)
    normal, shift = _normal(size)
    head, tail = _log_pair((normal, x.like(0.0)), shift)
    head, tail = where(size < INF, head, size), where(size < INF, tail, 0.0)
    head = where(size.equals(0.0), -INF, head)
    product = y * head
    low = fma(y, head, -product) + y * tail
    inside = absolute(product) < 800.0
    r, k = _exponent(_clamp(product, -800.0, 800.0), where(inside, low, 0.0))
    head, tail = _one_plus(_exp_fraction(r))
    result = _scale(head + tail, k)

    length = absolute(y)
    whole = length.equals((length + 2.0**52) - 2.0**52) | (length >= 2.0**52)
    half = 0.5 * length
    odd = whole & (half.compare("!=", (half + 2.0**52) - 2.0**52)) & (length < 2.0**53)
    result = result.flip(where(odd, x.sign(), 0))
    result = where((x < 0.0) & (x > -INF) & ~whole, NAN, result)
    result = where(x.compare("!=", x) | y.compare("!=", y), x + y, result)
    return where(x.equals(1.0) | y.equals(0.0) | (x.equals(-1.0) & length.equals(INF)), 1.0, result)


def _cbrt(x: Number) -> Number:
    """x = m 8^j with 1 ≤ m < 8; two steps of Halley from a polynomial, and Newton's correction of an exact residual."""
    normal, shift = _normal(absolute(x))
    bits = normal.bits()
    exponent = ((bits >> 52) | (1075 << 52)).double() - (2.0**52 + 1023)
    shifted = fma(exponent, 1 / 3, _ROUND - 1 / 3)
    j = _round(shifted)
    m = (bits - ((shifted.bits() * 3) << 52)).double()
    root = polynomial(m, CBRT)
    for _ in range(2):
        cube = root * root * root
        root = root * fma(m, 2.0, cube) / fma(cube, 2.0, m)
    square, square_low = two_product(root, root)
    rest = fma(-square, root, m) - square_low * root
    cube_root = root + rest / (3.0 * square)
    power = ((j + shift / 3.0 + _ROUND).bits() << 52) + _ONE
    result = _copy_sign(cube_root * power.double(), x)
    return where((absolute(x) < INF) & x.compare("!=", 0.0), result, x)


# Emitting


def _call(name: str, formula: Callable, args: tuple[Number, ...], attribute: str | None = None) -> tuple[Number, ...]:
    """Call the module's function of that name and number of lanes; define it by the formula if it is not there."""
    builder, type_ = args[0].builder, args[0].value.type
    symbol = f"lieint.{name}.{getattr(type_, 'count', 'scalar')}"
    if symbol not in builder.module.globals:
        returned = [with_element(type_, element) for element in _RETURNED.get(name, [DOUBLE])]
        signature = ir.FunctionType(ir.LiteralStructType(returned), [argument.value.type for argument in args])
        function = ir.Function(builder.module, signature, symbol)
        function.linkage = "internal"
        if attribute:
            function.attributes.add(attribute)
        inside: Llvm = ir.IRBuilder(function.append_basic_block())
        results = formula(*(Number(inside, argument) for argument in function.args))
        values = [number.value for number in (results if isinstance(results, tuple) else (results,))]
        packed: Llvm = ir.Constant(signature.return_type, ir.Undefined)
        for part, value in enumerate(values):
            packed = inside.insert_value(packed, value, part)
        inside.ret(packed)
    packed = builder.call(builder.module.globals[symbol], [argument.value for argument in args])
    parts = range(len(packed.type.elements))
    return tuple(Number(builder, builder.extract_value(packed, part)) for part in parts)


_RETURNED = {"sincos": [DOUBLE, DOUBLE], **dict.fromkeys(("reduce_large", "payne_hanek"), (DOUBLE, DOUBLE, INT))}
_INLINED = {"sin", "cos", "sincos", "exp", "log", "atan2"}


def _emit(name: str, formula: Callable, builder: Llvm, args: tuple[Llvm, ...]) -> list[Llvm]:
    """The values of a function, computed as doubles and rounded to the type of the arguments."""
    type_ = args[0].type
    doubles = with_element(type_, DOUBLE)
    narrow = type_ != doubles
    numbers = tuple(Number(builder, builder.fpext(value, doubles) if narrow else value) for value in args)
    results = _call(name, formula, numbers, "alwaysinline" if name in _INLINED else None)
    return [builder.fptrunc(number.value, type_) if narrow else number.value for number in results]


def sincos(builder: Llvm, x: Llvm) -> tuple[Llvm, Llvm]:
    """(sin x, cos x) with one reduction; the bits are those of both functions."""
    sine, cosine = _emit("sincos", _sincos, builder, (x,))
    return sine, cosine


def _emitter(name: str, formula: Callable) -> Callable[..., ir.Value]:
    def emit(builder: Llvm, *args: Llvm) -> Llvm:
        return _emit(name, formula, builder, args)[0]

    return emit


FUNCTIONS: dict[str, Callable[..., ir.Value]] = {
    name: _emitter(name, formula)
    for name, formula in {
        "sin": _sin, "cos": _cos, "tan": _tan, "asin": _asin, "acos": _acos, "atan": _atan, "atan2": _atan2,
        "sinh": _sinh, "cosh": _cosh, "tanh": _tanh, "asinh": _asinh, "acosh": _acosh, "atanh": _atanh,
        "exp": _exp, "exp2": _exp2, "expm1": _expm1, "log": _log, "log1p": _log1p,
        "cbrt": _cbrt, "pow": _pow, "logistic": _logistic,
    }.items()
}  # fmt: skip
