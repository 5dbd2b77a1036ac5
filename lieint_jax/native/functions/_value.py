"""Values of LLVM functions, written with Python's operators, and functions from formulas of them.

Nothing here sets fast-math flags, and a fused multiply-add is written as `fma`: the bits of a result depend neither on
the number of lanes nor on the optimizations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lieint_jax.native._llvm import Module, Text, constant, instruction, with_lanes
from lieint_jax.native._program import COMPARISONS
from lieint_jax.native.functions.coefficients import SHIFT

_Operator = Callable[["LlvmValue", "LlvmValue | float"], "LlvmValue"]


def _operator(op: str, reverse: bool = False) -> _Operator:
    """The operator of an operation on two values; a comparison has truth values."""

    def operator(self: LlvmValue, other: LlvmValue | float) -> LlvmValue:
        left, right = (self.like(other), self) if reverse else (self, self.like(other))
        scalar = "i1" if op in COMPARISONS else self.scalar
        return self.compute(f"{instruction(op, 'f' if self.is_double else 'i')} {left.typed}, {right.name}", scalar)

    return operator


@dataclass(frozen=True, eq=False)
class LlvmValue:
    """A double, an integer or a truth value per lane. Python numbers become constants of the same type.

    Attributes:
        text: the function that computes it.
        scalar: the type of a lane.
        lanes: how many there are; 0 for a scalar.
        name: its name in the text, or a constant.
    """

    text: Text
    scalar: str
    lanes: int
    name: str

    __add__ = __radd__ = _operator("add")
    __mul__ = __rmul__ = _operator("mul")
    __sub__, __rsub__ = _operator("sub"), _operator("sub", reverse=True)
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", reverse=True)
    __and__, __or__, __xor__ = map(_operator, ("and", "or", "xor"))
    __lshift__, __rshift__ = map(_operator, ("shift_left", "shift_right_logical"))
    __lt__, __le__, __gt__, __ge__ = map(_operator, ("lt", "le", "gt", "ge"))
    equals, differs = map(_operator, ("eq", "ne"))

    def __neg__(self):
        return self.compute(f"fneg {self.typed}")

    def __abs__(self):
        return self.intrinsic("fabs")

    def __invert__(self):
        return self ^ -1

    @property
    def is_double(self) -> bool:
        """Whether it is a double per lane."""
        return self.scalar == "double"

    @property
    def type(self) -> str:
        """The type of all lanes."""
        return with_lanes(self.scalar, self.lanes)

    @property
    def typed(self) -> str:
        """The value after its type, as an operand."""
        return f"{self.type} {self.name}"

    def constant(self, scalar: str, value: float) -> LlvmValue:
        """A constant with as many lanes."""
        return LlvmValue(self.text, scalar, self.lanes, constant(scalar, value, self.lanes))

    def like(self, other: LlvmValue | float) -> LlvmValue:
        """`other` as a value of this type."""
        if isinstance(other, LlvmValue):
            return other
        return self.constant(self.scalar, float(other) if self.is_double else other)

    def compute(self, instruction: str, scalar: str = "") -> LlvmValue:
        """The result of an instruction, with as many lanes, by default of the same type."""
        return LlvmValue(self.text, scalar or self.scalar, self.lanes, self.text.add(instruction))

    def convert(self, instruction: str, scalar: str) -> LlvmValue:
        """The value as another type, by an instruction such as `trunc`."""
        return self.compute(f"{instruction} {self.typed} to {with_lanes(scalar, self.lanes)}", scalar)

    def is_nan(self) -> LlvmValue:
        """Whether it is not a number."""
        return self.differs(self)

    def bits(self) -> LlvmValue:
        """The bits of doubles as integers."""
        return self.convert("bitcast", "i64")

    def double(self) -> LlvmValue:
        """The doubles of these bits."""
        return self.convert("bitcast", "double")

    def sign(self) -> LlvmValue:
        """The sign bit, in its place."""
        return self.bits() & (1 << 63)

    def flip(self, sign: LlvmValue) -> LlvmValue:
        """Minus this number where the sign bit is set."""
        return (self.bits() ^ sign).double()

    def intrinsic(self, name: str, *others: LlvmValue | float) -> LlvmValue:
        """The value of a function of LLVM."""
        operands = (self.like(other).name for other in (self, *others))
        return LlvmValue(self.text, self.scalar, self.lanes, self.text.intrinsic(name, self.type, *operands))


def where(condition: LlvmValue, yes: LlvmValue | float, no: LlvmValue | float) -> LlvmValue:
    """`yes` in the lanes where the condition holds, `no` in the others; at least one of them is an `LlvmValue`."""
    either = yes if isinstance(yes, LlvmValue) else no
    assert isinstance(either, LlvmValue)
    return either.compute(f"select {condition.typed}, {either.like(yes).typed}, {either.like(no).typed}")


def fma(a: LlvmValue, b: LlvmValue | float, c: LlvmValue | float) -> LlvmValue:
    """a b + c, rounded once."""
    return a.intrinsic("fma", b, c)


def sqrt(a: LlvmValue) -> LlvmValue:
    """The square root, correctly rounded."""
    return a.intrinsic("sqrt")


def polynomial(x: LlvmValue, coefficients: tuple[float, ...]) -> LlvmValue:
    """c₀ + c₁ x + c₂ x² + …, by Estrin's scheme: pairs, then pairs of pairs."""
    terms: list = list(coefficients)
    while len(terms) > 1:
        pairs = (terms[i : i + 2] for i in range(0, len(terms), 2))
        terms = [fma(x, pair[1], pair[0]) if len(pair) == 2 else pair[0] for pair in pairs]
        x = x * x
    return terms[0]


def unshift(shifted: LlvmValue) -> LlvmValue:
    """The integer k of k + `SHIFT`."""
    return shifted - SHIFT


def copy_sign(magnitude: LlvmValue, sign: LlvmValue) -> LlvmValue:
    """The magnitude, not negative, with the sign of another number."""
    return (magnitude.bits() | sign.sign()).double()


Formula = Callable[..., LlvmValue | tuple[LlvmValue, ...]]


def define(
    module: Module, name: str, formula: Formula, scalars: Sequence[str], lanes: int, attributes: str = ""
) -> None:
    """Define a function, unless the module has it.

    Args:
        module: the module to which it is added.
        name: of the function.
        formula: computes the result from the arguments; several results become a structure.
        scalars: the types of the arguments, without their lanes.
        lanes: of all arguments and results; 0 for scalars.
        attributes: of the function.
    """
    if name in module.parts:
        return
    text = Text(module)
    arguments = [LlvmValue(text, scalar, lanes, f"%a{k}") for k, scalar in enumerate(scalars)]
    results = formula(*arguments)
    if isinstance(results, LlvmValue):
        kind, value = results.type, results.name
    else:
        kind, value = _structure([x.scalar for x in results], lanes), "poison"
        for k, x in enumerate(results):
            value = text.add(f"insertvalue {kind} {value}, {x.typed}, {k}")
    text.lines.append(f"  ret {kind} {value}")
    text.define(name, f"{kind} @{name}({', '.join(x.typed for x in arguments)}) {attributes}")


def call(name: str, formula: Formula, arguments: Sequence[LlvmValue], results: Sequence[str]) -> tuple[LlvmValue, ...]:
    """The results of a function that is not inlined; `results` are their types, without their lanes."""
    text, lanes = arguments[0].text, arguments[0].lanes
    name = f"{name}.{lanes}"
    define(text.module, name, formula, [x.scalar for x in arguments], lanes, "noinline")
    kind = _structure(results, lanes)
    found = text.add(f"call {kind} @{name}({', '.join(x.typed for x in arguments)})")
    return tuple(
        LlvmValue(text, scalar, lanes, text.add(f"extractvalue {kind} {found}, {k}"))
        for k, scalar in enumerate(results)
    )


def _structure(scalars: Sequence[str], lanes: int) -> str:
    return f"{{ {', '.join(with_lanes(scalar, lanes) for scalar in scalars)} }}"
