"""Arithmetic on values of LLVM programs, written with Python's operators, and double-double arithmetic on top of it.

Nothing here sets fast-math flags, and a fused multiply-add is written as `fma`: the bits of a result depend neither on
the number of lanes nor on the optimizations.
"""

from dataclasses import dataclass
from typing import Any

from llvmlite import ir

DOUBLE, INT, BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
Llvm = Any  # an ir.IRBuilder or ir.Value: llvmlite has no annotations
_SIGN = 1 << 63


def with_element(type_: ir.Type, element: ir.Type) -> ir.Type:
    """The scalar or vector type of the same number of lanes with another element type."""
    return ir.VectorType(element, type_.count) if isinstance(type_, ir.VectorType) else element


@dataclass(frozen=True, eq=False)
class LlvmValue:
    """A double, a 64-bit integer or a truth value per lane. Python numbers become constants of the same type."""

    builder: Llvm
    value: Llvm

    def like(self, other: "LlvmValue | float") -> "LlvmValue":
        """`other` as a number of this type."""
        if isinstance(other, LlvmValue):
            return other
        type_ = self.value.type
        lanes = [other] * type_.count if isinstance(type_, ir.VectorType) else other
        return LlvmValue(self.builder, ir.Constant(type_, lanes))

    def _new(self, value: Llvm) -> "LlvmValue":
        return LlvmValue(self.builder, value)

    def _is_double(self) -> bool:
        return getattr(self.value.type, "element", self.value.type) == DOUBLE

    def _binary(self, real: str, integer: str, other: "LlvmValue | float", reverse: bool = False) -> "LlvmValue":
        operation = getattr(self.builder, real if self._is_double() else integer)
        left, right = self.value, self.like(other).value
        return self._new(operation(right, left) if reverse else operation(left, right))

    def __add__(self, other):
        return self._binary("fadd", "add", other)

    __radd__ = __add__

    def __mul__(self, other):
        return self._binary("fmul", "mul", other)

    __rmul__ = __mul__

    def __sub__(self, other):
        return self._binary("fsub", "sub", other)

    def __rsub__(self, other):
        return self._binary("fsub", "sub", other, reverse=True)

    def __truediv__(self, other):
        return self._binary("fdiv", "sdiv", other)

    def __rtruediv__(self, other):
        return self._binary("fdiv", "sdiv", other, reverse=True)

    def __and__(self, other):
        return self._new(self.builder.and_(self.value, self.like(other).value))

    def __or__(self, other):
        return self._new(self.builder.or_(self.value, self.like(other).value))

    def __xor__(self, other):
        return self._new(self.builder.xor(self.value, self.like(other).value))

    def __invert__(self):
        return self._new(self.builder.not_(self.value))

    def __lshift__(self, bits):
        return self._new(self.builder.shl(self.value, self.like(bits).value))

    def __rshift__(self, bits):
        """Logical: zeros come in."""
        return self._new(self.builder.lshr(self.value, self.like(bits).value))

    def __neg__(self):
        return self._new(self.builder.fneg(self.value))

    def compare(self, operator: str, other: "LlvmValue | float") -> "LlvmValue":
        """False where a double is NaN, but for `!=`."""
        right = self.like(other).value
        if not self._is_double():
            return self._new(self.builder.icmp_signed(operator, self.value, right))
        compare = self.builder.fcmp_unordered if operator == "!=" else self.builder.fcmp_ordered
        return self._new(compare(operator, self.value, right))

    def __lt__(self, other):
        return self.compare("<", other)

    def __le__(self, other):
        return self.compare("<=", other)

    def __gt__(self, other):
        return self.compare(">", other)

    def __ge__(self, other):
        return self.compare(">=", other)

    def equals(self, other):
        """Whether both are equal, lane by lane."""
        return self.compare("==", other)

    def bits(self) -> "LlvmValue":
        """The bits of doubles as integers."""
        return self._new(self.builder.bitcast(self.value, with_element(self.value.type, INT)))

    def double(self) -> "LlvmValue":
        """The doubles of these bits."""
        return self._new(self.builder.bitcast(self.value, with_element(self.value.type, DOUBLE)))

    def intrinsic(self, name: str, *others: "LlvmValue | float") -> "LlvmValue":
        """The value of an LLVM intrinsic `llvm.name` of doubles."""
        type_, module = self.value.type, self.builder.module
        symbol = f"llvm.{name}.{f'v{type_.count}' if isinstance(type_, ir.VectorType) else ''}f64"
        signature = ir.FunctionType(type_, [type_] * (1 + len(others)))
        function = module.globals.get(symbol) or ir.Function(module, signature, symbol)
        return self._new(self.builder.call(function, [self.value, *(self.like(other).value for other in others)]))

    def sign(self) -> "LlvmValue":
        """The sign bit, in its place."""
        return self.bits() & _SIGN

    def flip(self, sign: "LlvmValue") -> "LlvmValue":
        """Minus this number where the sign bit is set."""
        return (self.bits() ^ sign).double()


def where(condition: LlvmValue, yes: LlvmValue | float, no: LlvmValue | float) -> LlvmValue:
    """`yes` in the lanes where the condition holds, `no` in the others; at least one of them is a `LlvmValue`."""
    number = yes if isinstance(yes, LlvmValue) else no
    assert isinstance(number, LlvmValue)
    left, right = number.like(yes).value, number.like(no).value
    return LlvmValue(condition.builder, condition.builder.select(condition.value, left, right))


def fma(a: LlvmValue, b: LlvmValue | float, c: LlvmValue | float) -> LlvmValue:
    """a b + c, rounded once."""
    return a.intrinsic("fma", b, c)


def sqrt(a: LlvmValue) -> LlvmValue:
    """The square root, correctly rounded."""
    return a.intrinsic("sqrt")


def absolute(a: LlvmValue) -> LlvmValue:
    """|a|."""
    return a.intrinsic("fabs")


def polynomial(x: LlvmValue, coefficients: tuple[float, ...]) -> LlvmValue:
    """c₀ + c₁ x + c₂ x² + …, by Estrin's scheme: pairs, then pairs of pairs."""
    terms: list = [
        fma(x, pair[1], pair[0]) if len(pair) == 2 else x.like(pair[0])
        for pair in (coefficients[i : i + 2] for i in range(0, len(coefficients), 2))
    ]
    while len(terms) > 1:
        x = x * x
        pairs = (terms[i : i + 2] for i in range(0, len(terms), 2))
        terms = [fma(x, pair[1], pair[0]) if len(pair) == 2 else pair[0] for pair in pairs]
    return terms[0]


# A double-double is a pair (h, l) that stands for h + l, |l| ≤ ulp(h)/2 or little more. The operations are those of
# Dekker; see Muller et al., Handbook of Floating-Point Arithmetic, chapters 4 and 5.
Pair = tuple[LlvmValue, LlvmValue]


def fast_two_sum(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a + b exactly, for |a| ≥ |b| or a = 0."""
    total = a + b
    return total, b - (total - a)


def two_sum(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a + b exactly."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def two_product(a: LlvmValue, b: LlvmValue | float) -> Pair:
    """a b exactly."""
    product = a * b
    return product, fma(a, b, -product)


def add(a: Pair, b: Pair) -> Pair:
    """The sum of pairs of one sign, or with |a| well above |b|."""
    high, low = two_sum(a[0], b[0])
    return fast_two_sum(high, low + (a[1] + b[1]))


def multiply(a: Pair, b: Pair) -> Pair:
    """The product of pairs."""
    high, low = two_product(a[0], b[0])
    return fast_two_sum(high, fma(a[0], b[1], fma(a[1], b[0], low)))


def divide(a: Pair, b: Pair) -> Pair:
    """The quotient of pairs."""
    quotient = a[0] / b[0]
    rest = fma(-quotient, b[0], a[0]) + fma(-quotient, b[1], a[1])
    return fast_two_sum(quotient, rest / b[0])


def root(a: Pair) -> Pair:
    """The square root of a pair; (0, 0) of zero."""
    high = sqrt(a[0])
    low = (fma(-high, high, a[0]) + a[1]) / (high + high)
    return high, where(a[0].equals(0.0), 0.0, low)
