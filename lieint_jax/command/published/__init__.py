"""Published numbers of other codes, recomputed: each case names its source, its inputs and what limits the agreement.

`cases()` lists the cases, `Case.compare()` runs one; the command `lieint check --published` prints all comparisons. The
numbers are in `numbers.json`.
"""

from lieint_jax.command.published import _bodies, _detumbling  # noqa: F401  they declare the cases
from lieint_jax.command.published._case import CASES, Case, Comparison, numbers

__all__ = ["Case", "Comparison", "cases", "numbers"]


def cases() -> tuple[Case, ...]:
    """All cases, in the order of `numbers.json`."""
    return tuple(CASES[name] for name in numbers())
