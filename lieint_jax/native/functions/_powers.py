"""Powers and the cube root."""

from lieint_jax.native.functions._double_double import pair, two_product
from lieint_jax.native.functions._exponentials import clamp, exp_fraction, one_plus, reduce_exponent, scale
from lieint_jax.native.functions._logarithms import log_pair, normalize
from lieint_jax.native.functions._value import LlvmValue, copy_sign, fma, polynomial, unshift, where
from lieint_jax.native.functions.coefficients import CBRT, INF, NAN, ONE, SHIFT


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


POWERS = {"pow": _pow, "cbrt": _cbrt}
