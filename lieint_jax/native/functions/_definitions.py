"""Functions of an LLVM module, from formulas of values."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lieint_jax.native._llvm import Module, Text, with_lanes
from lieint_jax.native.functions._value import LlvmValue

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
