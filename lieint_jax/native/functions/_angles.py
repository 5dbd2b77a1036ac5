"""Sines and tangents, and their inverses. |x| > 2²⁴ is reduced by a table of the bits of 2/π, in a branch."""

import math
from collections.abc import Callable

from llvmlite import ir

from lieint_jax.native._number import (
    BIT,
    DOUBLE,
    INT,
    Llvm,
    LlvmValue,
    Pair,
    absolute,
    divide,
    fast_two_sum,
    fma,
    multiply,
    polynomial,
    root,
    two_product,
    where,
    with_element,
)
from lieint_jax.native.functions._calls import call_function
from lieint_jax.native.functions._floats import (
    EXPONENT,
    HALF_PI,
    HALF_PI_29_BITS,
    INF,
    LARGE_ANGLE,
    SHIFT,
    SIGN_BIT,
    choose,
    copy_sign,
    unshift,
)
from lieint_jax.native.functions.coefficients import ATAN, COS, SIN


def _reduce(x: LlvmValue) -> tuple[LlvmValue, LlvmValue, LlvmValue]:
    """(r, −l, k): x = k π/2 + r + l, |r| ≤ π/4 and a little, k in the low bits of an integer.

    Cody and Waite with FMA (Li, Boldo & Daumas, IEEE Trans. Comp. 60, 2011): x − kP₁ is exact. P₂ has 29 bits, thus
    k P₂ is exact for |k| ≤ 2²⁴, and with it the error of the next difference. The least |r| there is 2^−60.5, and the
    error of r + l 2^−113.
    """
    shifted = fma(x, 2 / math.pi, SHIFT)
    k = unshift(shifted)
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
        again = call_function("reduce_large", _reduce_large, (x, *reduced), "noinline")
        after = builder.block
    joined = []
    for first, second in zip(reduced, again, strict=True):
        phi = builder.phi(first.value.type)
        phi.add_incoming(first.value, before)
        phi.add_incoming(second.value, after)
        joined.append(LlvmValue(builder, phi))
    r, minus_l, k = joined
    return r, minus_l, k


def _reduce_large(x: LlvmValue, *reduced: LlvmValue) -> tuple[LlvmValue, ...]:
    """(r, −l, k) with the lanes of finite |x| > 2²⁴ reduced again, one by one."""
    builder, type_ = x.builder, x.value.type
    large = (absolute(x) > LARGE_ANGLE) & (absolute(x) < INF)
    if not isinstance(type_, ir.VectorType):
        lanes = call_function("payne_hanek", _payne_hanek, (x,), "noinline")
        return tuple(where(large, new, old) for new, old in zip(lanes, reduced, strict=True))
    values: list[Llvm] = [number.value for number in reduced]
    for index in map(ir.IntType(32), range(type_.count)):
        lane = LlvmValue(builder, builder.extract_element(x.value, index))
        for part, number in enumerate(call_function("payne_hanek", _payne_hanek, (lane,), "noinline")):
            values[part] = builder.insert_element(values[part], number.value, index)
    return tuple(where(large, LlvmValue(builder, new), old) for new, old in zip(values, reduced, strict=True))


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


def _payne_hanek(x: LlvmValue) -> tuple[LlvmValue, LlvmValue, LlvmValue]:
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
    leading = [LlvmValue(builder, builder.trunc(builder.lshr(magnitude, _WIDE(192 - n)), INT)) for n in (53, 106)]
    high, low = (
        LlvmValue(builder, builder.sitofp((part & ((1 << 53) - 1)).value, DOUBLE)) * 2.0**-n
        for part, n in zip(leading, (53, 106), strict=True)
    )
    head, tail = multiply((high, low), (high.like(HALF_PI[0]), high.like(HALF_PI[1])))
    shift = LlvmValue(builder, builder.trunc(zeros, INT))
    scale = ((shift.like(1023) - shift) << 52).double()
    negative = LlvmValue(builder, builder.icmp_signed("<", bits, INT(0)))
    sign = where(negative ^ LlvmValue(builder, below), shift.like(SIGN_BIT), 0)
    head, tail = ((part * scale).flip(sign) for part in (head, tail))
    k = where(negative, 0 - LlvmValue(builder, quadrant), LlvmValue(builder, quadrant))
    return head, -tail, k


def _angle_parts(x: LlvmValue) -> tuple[Pair, Pair, LlvmValue]:
    """(sin r, cos r, k) of x = k π/2 + r, sin and cos as pairs that are not yet added."""
    r, minus_l, k = _reduce(x)
    square = r * r
    half = -0.5 * r
    cosine = fma(r, half, 1.0)
    rest = fma(r, half, 1.0 - cosine)  # 1 − r²/2 = cosine + rest
    minus_tail = fma(r * square, polynomial(square, tuple(-c for c in SIN)), minus_l * cosine)
    cosine_tail = fma(square * square, polynomial(square, COS), fma(r, minus_l, rest))
    return (r, -minus_tail), (cosine, cosine_tail), k


def sine_and_cosine(x: LlvmValue) -> Pair:
    """(sin x, cos x)."""
    sine, cosine, k = _angle_parts(x)
    sine, cosine = sine[0] + sine[1], cosine[0] + cosine[1]
    odd = (k << 63) < 0
    return (
        where(odd, cosine, sine).flip((k & 2) << 62),
        where(odd, sine, cosine).flip(((k + 1) & 2) << 62),
    )


def _sin(x: LlvmValue) -> LlvmValue:
    return sine_and_cosine(x)[0]


def _cos(x: LlvmValue) -> LlvmValue:
    return sine_and_cosine(x)[1]


def _tan(x: LlvmValue) -> LlvmValue:
    """sin r / cos r, or −cos r / sin r."""
    sine, cosine, k = _angle_parts(x)
    odd = (k << 63) < 0
    sine, cosine = fast_two_sum(*sine), fast_two_sum(*cosine)
    above, below = (choose(odd, cosine, sine), choose(odd, sine, cosine))
    head, tail = divide(above, below)
    return where(x.equals(0.0), x, (head + tail).flip(k << 63))


def _angle(y: Pair, x: Pair, swapped: LlvmValue, negative: LlvmValue) -> LlvmValue:
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
    sign = where(folded ^ swapped ^ negative, t.bits().like(SIGN_BIT), 0)
    t, t_low = t.flip(sign), t_low.flip(sign)
    quarter_pi = (0.5 * HALF_PI[0], 0.5 * HALF_PI[1])
    base = eighths * quarter_pi[0]
    base_low = fma(eighths, quarter_pi[1], fma(eighths, quarter_pi[0], -base))
    head, tail = fast_two_sum(base, t)
    square = t * t
    t_low = fma(-t_low, square, t_low)  # times 1/(1 + t²), the derivative, nearly
    return head + (tail + (base_low + fma(t * square, polynomial(square, ATAN), t_low)))


def _atan2(y: LlvmValue, x: LlvmValue) -> LlvmValue:
    """The angle of the point (x, y); the larger coordinate is scaled to [2, 4)."""
    tall, wide = absolute(y), absolute(x)
    swapped = tall > wide
    small, great = where(swapped, wide, tall), where(swapped, tall, wide)
    infinite = great.equals(INF)
    small = where(infinite, where(small.equals(INF), small.like(1.0), 0.0), small)
    great = where(infinite | great.equals(0.0), 1.0, great)
    exponent = great.bits() & EXPONENT
    scale = (EXPONENT - where(exponent.equals(0), 1 << 52, exponent)).double()
    zero = y.like(0.0)
    angle = _angle((small * scale, zero), (great * scale, zero), swapped, x.bits() < 0)
    return where(x.compare("!=", x) | y.compare("!=", y), x + y, copy_sign(angle, y))


def _atan(x: LlvmValue) -> LlvmValue:
    size = absolute(x)
    steep = size > 1.0
    one, zero = x.like(1.0), x.like(0.0)
    size = where(size > 2.0**60, 2.0**60, size)  # arctan is π/2 there
    small, great = where(steep, one, size), where(steep, size, one)
    return copy_sign(_angle((small, zero), (great, zero), steep, _no_lane(x)), x)


def _no_lane(x: LlvmValue) -> LlvmValue:
    return LlvmValue(x.builder, ir.Constant(with_element(x.value.type, BIT), None))


def _leg(x: LlvmValue) -> Pair:
    """√(1 − x²) as a pair."""
    square, square_low = two_product(x, x)
    head = 1.0 - square
    return root(fast_two_sum(head, ((1.0 - head) - square) - square_low))


def _arc(y: Pair, x: Pair, negative: LlvmValue) -> LlvmValue:
    """The angle of a point of the upper half of the unit circle."""
    swapped = y[0] > x[0]
    return _angle(choose(swapped, x, y), choose(swapped, y, x), swapped, negative)


def _asin(x: LlvmValue) -> LlvmValue:
    return copy_sign(_arc((absolute(x), x.like(0.0)), _leg(x), _no_lane(x)), x)


def _acos(x: LlvmValue) -> LlvmValue:
    return _arc(_leg(x), (absolute(x), x.like(0.0)), x < 0.0)


ANGLES: dict[str, Callable] = {
    "sin": _sin, "cos": _cos, "tan": _tan, "asin": _asin, "acos": _acos, "atan": _atan, "atan2": _atan2,
}  # fmt: skip
