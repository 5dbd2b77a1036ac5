"""Elementary functions as vector code, within 1 ulp, with the same bits on every machine that has FMA.

`FUNCTIONS[name]` is a formula of doubles, or of vectors of them; floats are computed as doubles. All lanes run the same
instructions, without tables; sin, cos and tan have a branch and a table for |x| > 2²⁴.

Reductions follow Cody & Waite, *Software Manual for the Elementary Functions*, and Muller,
*Elementary Functions*, 3rd ed., chapters 10 and 11; pairs are double-doubles.
"""

from lieint_jax.native._llvm import Module
from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native.functions._angles import ANGLES
from lieint_jax.native.functions._exponentials import EXPONENTIALS, POWERS
from lieint_jax.native.functions._logarithms import LOGARITHMS
from lieint_jax.native.functions._value import Formula, LlvmValue, define

FUNCTIONS: dict[str, Formula] = {**ANGLES, **EXPONENTIALS, **LOGARITHMS, **POWERS}


class Functions(Module):
    """The functions that programs call."""

    def name(self, op: str, scalar: str, lanes: int, count: int) -> str:
        """The name of a function of `count` arguments, which are scalars if there are no lanes, otherwise vectors."""
        if op not in FUNCTIONS or scalar not in ("double", "float"):
            raise UnsupportedError(f"{op} of {scalar}")
        name, formula = f"{op}.{scalar}.{lanes}", FUNCTIONS[op]
        define(self, name, formula if scalar == "double" else _of_floats(formula), [scalar] * count, lanes)
        return name


def _of_floats(formula: Formula) -> Formula:
    """A function of floats, computed as doubles and rounded."""

    def rounded(*arguments: LlvmValue) -> LlvmValue | tuple[LlvmValue, ...]:
        found = formula(*(x.convert("fpext", "double") for x in arguments))
        if isinstance(found, LlvmValue):
            return found.convert("fptrunc", "float")
        return tuple(x.convert("fptrunc", "float") for x in found)

    return rounded
