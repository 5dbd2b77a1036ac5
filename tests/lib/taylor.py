"""Solutions of differential equations in many digits: Taylor series in fixed-point numbers, no code of the package."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction

BITS = 180  # of the fraction, 54 digits: all numbers of a problem must be of the order of 1
Number = int | float | Fraction


def fixed(x: Number) -> int:
    """x as a fixed-point number."""
    return round(Fraction(x) * 2**BITS)


def sqrt(x: Number) -> Fraction:
    """√x, rounded down to the last bit."""
    return Fraction(math.isqrt(fixed(x) << BITS), 2**BITS)


class Series:
    """A power series in t, of which `rule(n)` computes the n-th coefficient from lower ones and from its arguments."""

    def __init__(self, problem: list[Series], rule: Callable[[int], int] | None):
        self.terms: list[int] = []
        self.problem, self.rule = problem, rule
        problem.append(self)

    def _new(self, rule: Callable[[int], int]) -> Series:
        return Series(self.problem, rule)

    def __add__(self, other: Series | Number) -> Series:
        if isinstance(other, Series):
            return self._new(lambda n: self.terms[n] + other.terms[n])
        constant = fixed(other)
        return self._new(lambda n: self.terms[n] + (constant if n == 0 else 0))

    def __mul__(self, other: Series | Number) -> Series:
        if isinstance(other, Series):
            a, b = self.terms, other.terms
            return self._new(lambda n: sum(map(operator.mul, a[: n + 1], b[n::-1])) >> BITS)
        factor = fixed(other)
        return self._new(lambda n: self.terms[n] * factor >> BITS)

    def __pow__(self, power: Number) -> Series:
        """A power p or p/2 of a positive series, p an integer: n a₀ cₙ = Σ (p(n − k) − k) aₙ₋ₖ cₖ."""
        power = Fraction(power)
        p, q = power.numerator, power.denominator
        made = self._new(lambda n: 0)
        a, c = self.terms, made.terms

        def rule(n: int) -> int:
            if n == 0:
                x = Fraction(a[0], 2**BITS)
                return fixed((x if q == 1 else sqrt(x)) ** p)
            total = sum((p * (n - k) - q * k) * a[n - k] * c[k] for k in range(n))
            return total // (q * n * a[0])

        made.rule = rule
        return made

    def __neg__(self) -> Series:
        return self * -1

    def __sub__(self, other: Series | Number) -> Series:
        return self + -other

    def __rsub__(self, other: Number) -> Series:
        return -self + other

    def __truediv__(self, other: Number) -> Series:
        return self * (1 / Fraction(other))

    __radd__, __rmul__ = __add__, __mul__


def solve(
    rate: Callable[[list[Series]], Sequence[Series | Number]],
    start: Sequence[Number],
    times: Sequence[Number],
    longest: Number,
    order: int = 40,
) -> list[list[Fraction]]:
    """The states at the times, the first of which is that of `start`.

    Args:
        rate: dy/dt as a function of the components of y; +, −, ·, powers of positive numbers, division by numbers.
        start: y at the first time.
        times: increasing.
        longest: the longest step.
        order: of the series.
    """
    problem: list[Series] = []
    y = [Series(problem, None) for _ in start]
    dy = [x if isinstance(x, Series) else y[0] * 0 + x for x in rate(y)]
    values, found = [fixed(x) for x in start], [[Fraction(x) for x in start]]
    rules = problem[len(y) :]
    for begin, end in itertools.pairwise(times):
        span = Fraction(end) - Fraction(begin)
        steps = -(-span // Fraction(longest))
        h = fixed(span / steps)
        for _ in range(steps):
            for series in problem:
                series.terms.clear()
            for series, value in zip(y, values, strict=True):
                series.terms.append(value)
            for n in range(order):
                for series in rules:
                    series.terms.append(series.rule(n))  # pyright: ignore[reportOptionalCall]
                for series, slope in zip(y, dy, strict=True):
                    series.terms.append((slope.terms[n] * h >> BITS) // (n + 1))
            values = [sum(series.terms) for series in y]
        found.append([Fraction(value, 2**BITS) for value in values])
    return found
