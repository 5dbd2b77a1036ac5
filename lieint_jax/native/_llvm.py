"""Text of LLVM IR: modules and functions as they grow, types, constants, instructions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np

from lieint_jax.native._program import COMPARISONS

_BITS = {
    "and": "and", "or": "or", "xor": "xor",
    "shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr",
}  # fmt: skip


class Module:
    """A module.

    Attributes:
        parts: its functions and constants, by their names or what they hold.
        declared: the declarations of functions that are defined elsewhere.
    """

    def __init__(self) -> None:
        self.parts: dict[object, str] = {}
        self.declared: dict[str, None] = {}

    def text(self) -> str:
        """The whole module."""
        return "\n".join([*self.declared, *self.parts.values()])


class Text:
    """The text of a function of a module."""

    def __init__(self, module: Module):
        self.module = module
        self.front: list[str] = []  # what comes before all lines
        self.lines: list[str] = []
        self.label = "entry"
        self.count = 0

    def new(self) -> str:
        self.count += 1
        return f"%v{self.count}"

    def add(self, text: str) -> str:
        """Write an instruction that has a result, and return its name."""
        name = self.new()
        self.lines.append(f"  {name} = {text}")
        return name

    def begin(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.label = label

    def new_label(self, name: str) -> str:
        self.count += 1
        return f"{name}{self.count}"

    def jump(self, label: str) -> None:
        self.lines.append(f"  br label %{label}")

    @contextlib.contextmanager
    def counted_loop(self, name: str, end: int | str, step: int = 1, first: str = "0") -> Iterator[str]:
        """A loop over the indices from `first` below `end`, each `step`-th of them; it is run once at least."""
        before, head, exit_ = self.label, self.new_label(name), self.new_label(f"{name}.exit")
        self.jump(head)
        self.begin(head)
        index, place = self.new(), len(self.lines)
        yield index
        after = self.add(f"add i64 {index}, {step}")
        more = self.add(f"icmp slt i64 {after}, {end}")
        self.insert_phis(place, before, [(index, "i64", first, after)])
        self.lines.append(f"  br i1 {more}, label %{head}, label %{exit_}")
        self.begin(exit_)

    def insert_phis(self, place: int, before: str, carried: Sequence[tuple[str, str, str, str]]) -> None:
        """Write at `place` what a loop carries that ends here: (name, type, value before it, value of the next)."""
        self.lines[place:place] = [
            f"  {name} = phi {kind} [ {start}, %{before} ], [ {following}, %{self.label} ]"
            for name, kind, start, following in carried
        ]

    def call(self, result: str, name: str, arguments: Sequence[tuple[str, str]]) -> str:
        """Call a function that is declared elsewhere; arguments are (type, value)."""
        self.module.declared[f"declare {result} @{name}({', '.join(t for t, _ in arguments)})"] = None
        return self.add(f"call {result} @{name}({', '.join(f'{t} {v}' for t, v in arguments)})")

    def intrinsic(self, name: str, kind: str, *values: str) -> str:
        """Call a function of LLVM whose result and arguments have one type."""
        return self.call(kind, f"llvm.{name}.{suffix(kind)}", [(kind, v) for v in values])

    def define(self, name: str, head: str) -> None:
        """Add the function to its module."""
        self.module.parts[name] = "\n".join([f"define {head} {{\nentry:", *self.front, *self.lines, "}"])


def with_lanes(scalar: str, lanes: int) -> str:
    """The type of a vector, or of a scalar if there are no lanes."""
    return f"<{lanes} x {scalar}>" if lanes else scalar


def suffix(kind: str) -> str:
    """The end of the name of an intrinsic, such as v8f64 for <8 x double>."""
    short = kind.replace("double", "f64").replace("float", "f32")
    return short.replace("<", "v").replace(" x ", "").replace(">", "")


def constant(scalar: str, value: np.generic | float, lanes: int) -> str:
    """A constant, the same in all lanes if there are any."""
    return f"splat ({scalar} {literal(value)})" if lanes else literal(value)


def literal(value: np.generic | float) -> str:
    """A constant as LLVM writes it; a real number by its bits as a double."""
    kind = np.asarray(value).dtype.kind
    if kind == "f":
        return f"0x{np.float64(value).view(np.uint64):016X}"
    return str(bool(value)).lower() if kind == "b" else str(int(value))


def instruction(op: str, kind: str) -> str:
    """The instruction of an operation for one of NumPy's kinds of types; empty if there is none.

    Comparisons are false for NaN, but for "ne".
    """
    if op in ("add", "sub", "mul"):
        return f"f{op}" if kind == "f" else op
    if op in ("div", "rem"):
        return {"f": "f", "i": "s", "u": "u"}[kind] + op
    if op in COMPARISONS:
        if kind == "f":
            return "fcmp une" if op == "ne" else f"fcmp o{op}"
        sign = "" if op in ("eq", "ne") else "s" if kind == "i" else "u"
        return f"icmp {sign}{op}"
    return _BITS.get(op, "")
