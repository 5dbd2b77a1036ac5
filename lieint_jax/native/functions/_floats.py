"""Constants of double precision, and what formulas do to the bits of a double."""

import math

from lieint_jax.native.functions._value import LlvmValue

INF, NAN = math.inf, math.nan
HALF_PI = (1.5707963267948966, 6.123233995736766e-17)
HALF_PI_29_BITS = (6.12323399409214e-17, 1.6446256936324258e-26)  # the second of these, cut to 29 bits, and the rest
LN2 = (0.6931471805599453, 2.3190468138462996e-17)
LN2_42_BITS = (0.6931471805598903, 5.497923018708371e-14)  # integers to 2¹¹ times the first are exact
SHIFT = 1.5 * 2**52  # x + this: the low bits are those of round(x)
ONE, EXPONENT, SIGN_BIT = 1023 << 52, 0x7FF << 52, 1 << 63


def unshift(shifted: LlvmValue) -> LlvmValue:
    """The integer k of k + 1.5·2⁵²."""
    return shifted - SHIFT


def copy_sign(magnitude: LlvmValue, sign: LlvmValue) -> LlvmValue:
    """The magnitude, not negative, with the sign of another number."""
    return (magnitude.bits() | sign.sign()).double()
