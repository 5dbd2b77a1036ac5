"""Elementary functions as vector code, within 1 ulp, with the same bits on every machine that has FMA.

`FUNCTIONS[name](builder, *args)` emits a call of an internal LLVM function, which the module gets once per name and
number of lanes; LLVM inlines it. Arguments are `double`, `float` or vectors of them; floats are computed as doubles.
All lanes run the same instructions, without tables; sin, cos and tan have a branch and a table for |x| > 2²⁴.

Reductions follow Cody & Waite, *Software Manual for the Elementary Functions*, and Muller,
*Elementary Functions*, 3rd ed., chapters 10 and 11; pairs are double-doubles.
"""

from collections.abc import Callable

from llvmlite import ir

from lieint_jax.native._number import DOUBLE, Llvm, LlvmValue, with_element
from lieint_jax.native.functions._angles import ANGLES, sine_and_cosine
from lieint_jax.native.functions._calls import call_function
from lieint_jax.native.functions._exponentials import EXPONENTIALS
from lieint_jax.native.functions._logarithms import LOGARITHMS
from lieint_jax.native.functions._powers import POWERS

_INLINED = {"sin", "cos", "sincos", "exp", "log", "atan2"}


def _emit(name: str, formula: Callable, builder: Llvm, args: tuple[Llvm, ...]) -> list[Llvm]:
    """The values of a function, computed as doubles and rounded to the type of the arguments."""
    type_ = args[0].type
    doubles = with_element(type_, DOUBLE)
    narrow = type_ != doubles
    numbers = tuple(LlvmValue(builder, builder.fpext(value, doubles) if narrow else value) for value in args)
    results = call_function(name, formula, numbers, "alwaysinline" if name in _INLINED else None)
    return [builder.fptrunc(number.value, type_) if narrow else number.value for number in results]


def sincos(builder: Llvm, x: Llvm) -> tuple[Llvm, Llvm]:
    """(sin x, cos x) with one reduction; the bits are those of both functions."""
    sine, cosine = _emit("sincos", sine_and_cosine, builder, (x,))
    return sine, cosine


def _emitter(name: str, formula: Callable) -> Callable[..., ir.Value]:
    def emit(builder: Llvm, *args: Llvm) -> Llvm:
        return _emit(name, formula, builder, args)[0]

    return emit


FUNCTIONS: dict[str, Callable[..., ir.Value]] = {
    name: _emitter(name, formula) for name, formula in (ANGLES | EXPONENTIALS | LOGARITHMS | POWERS).items()
}
