"""The instructions of operations on two numbers."""

from lieint_jax.native._program import COMPARISONS

_BITS = {
    "and": "and", "or": "or", "xor": "xor",
    "shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr",
}  # fmt: skip


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
