"""Double-double arithmetic; see Muller et al., Handbook of Floating-Point Arithmetic, chapters 4 and 5."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from lieint_jax.native.functions._value import LlvmValue, fma, sqrt, where


@dataclass(frozen=True, eq=False)
class Pair:
    """The number high + low, |low| ≤ ulp(high)/2 or little more. The operations are those of Dekker."""

    high: LlvmValue
    low: LlvmValue

    def __iter__(self) -> Iterator[LlvmValue]:
        return iter((self.high, self.low))

    def __add__(self, other: Pair) -> Pair:
        """The sum of numbers of one sign, or with |self| well above |other|."""
        high, low = two_sum(self.high, other.high)
        return fast_two_sum(high, low + (self.low + other.low))

    def __radd__(self, other: float) -> Pair:
        return pair(self.high.like(other)) + self

    def __mul__(self, other: Pair) -> Pair:
        high, low = two_product(self.high, other.high)
        return fast_two_sum(high, fma(self.high, other.low, fma(self.low, other.high, low)))

    def __truediv__(self, other: Pair) -> Pair:
        quotient = self.high / other.high
        rest = fma(-quotient, other.high, self.high) + fma(-quotient, other.low, self.low)
        return fast_two_sum(quotient, rest / other.high)

    def __rtruediv__(self, other: float) -> Pair:
        return pair(self.high.like(other)) / self


def pair(high: LlvmValue, low: float = 0.0) -> Pair:
    """A double as a pair, or a pair with a constant low part."""
    return Pair(high, high.like(low))


def fast_two_sum(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a + b exactly, for |a| ≥ |b| or a = 0."""
    total = a + b
    return Pair(total, b - (total - a))


def two_sum(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a + b exactly."""
    total = a + b
    part = total - a
    return Pair(total, (a - (total - part)) + (b - part))


def two_product(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a b exactly."""
    product = a * b
    return Pair(product, fma(a, b, -product))


def root(a: Pair) -> Pair:
    """The square root of a pair; (0, 0) of zero."""
    high = sqrt(a.high)
    low = (fma(-high, high, a.high) + a.low) / (high + high)
    return Pair(high, where(a.high.equals(0.0), 0.0, low))


def choose(condition: LlvmValue, yes: Pair, no: Pair) -> Pair:
    """One of two pairs, by a boolean."""
    return Pair(where(condition, yes.high, no.high), where(condition, yes.low, no.low))
