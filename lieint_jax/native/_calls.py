"""The elementary functions that a module calls, as a separate module."""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native.functions import FUNCTIONS, sincos

_FLOATS: dict[str, Any] = {"double": ir.DoubleType(), "float": ir.FloatType()}


class Functions:
    """Collects the functions that are called, and writes the module that defines them."""

    def __init__(self) -> None:
        self._module = ir.Module()
        self._known: dict[tuple[str, str, int], str] = {}

    def name(self, op: str, scalar: str, lanes: int, count: int) -> str:
        """The name of a function of `count` arguments, which are scalars if there are no lanes, otherwise vectors."""
        key = op, scalar, lanes
        if key not in self._known:
            if op not in (*FUNCTIONS, "sincos") or scalar not in _FLOATS:
                raise UnsupportedError(f"{op} of {scalar}")
            kind = ir.VectorType(_FLOATS[scalar], lanes) if lanes else _FLOATS[scalar]
            result = ir.LiteralStructType([kind, kind]) if op == "sincos" else kind
            name = f"{op}.{scalar}.{lanes}"
            function = ir.Function(self._module, ir.FunctionType(result, [kind] * count), name)
            builder = ir.IRBuilder(function.append_basic_block())
            if op == "sincos":
                pair = ir.Constant(result, ir.Undefined)
                for k, value in enumerate(sincos(builder, *function.args)):
                    pair = builder.insert_value(pair, value, k)
                builder.ret(pair)
            else:
                builder.ret(FUNCTIONS[op](builder, *function.args))
            self._known[key] = name
        return self._known[key]

    def text(self) -> str:
        """The module; empty if nothing is called."""
        return str(self._module) if self._known else ""
