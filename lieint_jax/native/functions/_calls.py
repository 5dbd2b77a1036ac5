"""The internal LLVM function of a formula, defined at its first call in a module."""

from collections.abc import Callable

from llvmlite import ir

from lieint_jax.native._number import DOUBLE, INT, Llvm, LlvmValue, with_element

_RETURNED = {"sincos": [DOUBLE, DOUBLE], **dict.fromkeys(("reduce_large", "payne_hanek"), (DOUBLE, DOUBLE, INT))}


def call_function(
    name: str, formula: Callable, args: tuple[LlvmValue, ...], attribute: str | None = None
) -> tuple[LlvmValue, ...]:
    """Call the module's function of that name and number of lanes; define it by the formula if it is not there."""
    builder, type_ = args[0].builder, args[0].value.type
    symbol = f"lieint.{name}.{getattr(type_, 'count', 'scalar')}"
    if symbol not in builder.module.globals:
        returned = [with_element(type_, element) for element in _RETURNED.get(name, [DOUBLE])]
        signature = ir.FunctionType(ir.LiteralStructType(returned), [argument.value.type for argument in args])
        function = ir.Function(builder.module, signature, symbol)
        function.linkage = "internal"
        if attribute:
            function.attributes.add(attribute)
        inside: Llvm = ir.IRBuilder(function.append_basic_block())
        results = formula(*(LlvmValue(inside, argument) for argument in function.args))
        values = [number.value for number in (results if isinstance(results, tuple) else (results,))]
        packed: Llvm = ir.Constant(signature.return_type, ir.Undefined)
        for part, value in enumerate(values):
            packed = inside.insert_value(packed, value, part)
        inside.ret(packed)
    packed = builder.call(builder.module.globals[symbol], [argument.value for argument in args])
    parts = range(len(packed.type.elements))
    return tuple(LlvmValue(builder, builder.extract_value(packed, part)) for part in parts)
