"""Reduction of angles by multiples of π/2; that of |x| > 2²⁴ reads a table of the bits of 2/π, in a branch."""

import math

from lieint_jax.native._llvm import suffix
from lieint_jax.native.functions._double_double import Pair, pair
from lieint_jax.native.functions._value import LlvmValue, call, fma, unshift, where
from lieint_jax.native.functions.coefficients import HALF_PI, HALF_PI_29_BITS, INF, SHIFT, SIGN_BIT

_LARGE = 2.0**24
_PADDING = 32  # zeros before the bits of 2/π, so that the window of the smallest large angle begins at a byte
_LAST = 2046 + _PADDING - 1075 - 2  # the last bit of the table with which a window begins
_SIZE = _LAST // 8 + 24  # bytes of the table

Reduced = tuple[LlvmValue, ...]  # (r, −l, k)
_TYPES = "double", "double", "i64"


def reduce_angle(x: LlvmValue) -> Reduced:
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
    return _with_large_angles(x, (r, tail - (head - r), shifted.bits()))


def _with_large_angles(x: LlvmValue, reduced: Reduced) -> Reduced:
    """`reduced`, or a new reduction if any lane has a large angle, which is unlikely."""
    text, is_large = x.text, abs(x) > _LARGE
    some = is_large.name
    if x.lanes:
        some = text.call("i1", f"llvm.vector.reduce.or.{suffix(is_large.type)}", [(is_large.type, some)])
    before, large, after = text.label, text.new_label("large"), text.new_label("after")
    text.module.parts["unlikely"] = '!0 = !{!"branch_weights", i32 1, i32 99}'
    text.lines.append(f"  br i1 {some}, label %{large}, label %{after}, !prof !0")
    text.begin(large)
    again = call("reduce_large", _reduce_large, (x, *reduced), _TYPES)
    text.jump(after)
    text.begin(after)
    return tuple(
        old.compute(f"phi {old.type} [ {old.name}, %{before} ], [ {new.name}, %{large} ]")
        for old, new in zip(reduced, again, strict=True)
    )


def _reduce_large(x: LlvmValue, *reduced: LlvmValue) -> Reduced:
    """`reduced` with the lanes of finite |x| > 2²⁴ reduced again, one by one."""
    again: Reduced = reduced if x.lanes else call("payne_hanek", _payne_hanek, (x,), _TYPES)
    for k in range(x.lanes):
        lane = LlvmValue(x.text, x.scalar, 0, x.text.add(f"extractelement {x.typed}, i64 {k}"))
        parts = call("payne_hanek", _payne_hanek, (lane,), _TYPES)
        pairs = zip(again, parts, strict=True)
        again = tuple(old.compute(f"insertelement {old.typed}, {new.typed}, i64 {k}") for old, new in pairs)
    large = (abs(x) > _LARGE) & (abs(x) < INF)
    return tuple(where(large, new, old) for new, old in zip(again, reduced, strict=True))


def _payne_hanek(x: LlvmValue) -> Reduced:
    """(r, −l, k) of one double |x| > 2²⁴.

    x = m 2^E with an integer m. Of the bits of 2/π, those that contribute multiples of 4 to x · 2/π are left out; the
    next 192 times m, modulo 2¹⁹², are x · 2/π modulo 4 with an error below 2⁻¹³⁰ (Muller, section 11.4).
    """
    bits = x.bits()
    mantissa = bits & ((1 << 52) - 1) | 1 << 52
    first = ((bits >> 52) & 0x7FF) + (_PADDING - 1075 - 2)  # the bit of the table with which the window begins
    first = where(first > 0, first, 0)  # other lanes have small angles
    first = where(first < _LAST, first, _LAST)  # or infinite ones
    product = (mantissa << (first & 7)).convert("zext", "i192") * _window(first >> 3)

    quadrant = ((product + (1 << 189)) >> 190).convert("trunc", "i64")
    fraction = product << 2  # of a quadrant, as a signed number
    below = fraction < 0
    size = where(below, 0 - fraction, fraction)
    zeros = LlvmValue(x.text, "i192", 0, x.text.call("i192", "llvm.ctlz.i192", [("i192", size.name), ("i1", "true")]))
    size = size << zeros
    leading = [(size >> (192 - n)).convert("trunc", "i64") & ((1 << 53) - 1) for n in (53, 106)]
    high, low = (part.convert("sitofp", "double") * 2.0**-n for part, n in zip(leading, (53, 106), strict=True))
    head, tail = Pair(high, low) * pair(high.like(HALF_PI[0]), HALF_PI[1])
    shift = zeros.convert("trunc", "i64")
    scale = ((1023 - shift) << 52).double()
    negative = bits < 0
    sign = where(negative ^ below, shift.like(SIGN_BIT), 0)
    head, tail = ((part * scale).flip(sign) for part in (head, tail))
    return head, -tail, where(negative, 0 - quadrant, quadrant)


def _window(byte: LlvmValue) -> LlvmValue:
    """192 bits of 2/π from a byte on. The table begins with its last byte: a little-endian load has bits in order."""
    bits = _two_over_pi(8 * _SIZE - _PADDING).to_bytes(_SIZE, "little")
    table = "".join(f"\\{x:02X}" for x in bits)
    byte.text.module.parts["two_over_pi"] = f'@two_over_pi = internal constant [{_SIZE} x i8] c"{table}"'
    place = byte.text.add(f"getelementptr i8, ptr @two_over_pi, {(_SIZE - 24 - byte).typed}")
    return byte.compute(f"load i192, ptr {place}, align 1", "i192")


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
