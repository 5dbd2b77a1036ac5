"""Loops over the stages of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from jax import lax

from lieint_jax._xla import materialized_arrays, rematerialized, saved

_Carry = TypeVar("_Carry")


def scan_stages(
    stage: Callable[[_Carry, Any], tuple[_Carry, None]], carry: _Carry, stages: Any, store: bool = True
) -> _Carry:
    """The last carry of a `lax.scan` of `stage` over the rows of `stages`.

    Reverse mode computes each stage again, from the carries that it stores; without `store`, these too, for many or
    short stages. Forward, the numbers of a row are copied first: XLA does not vectorize a stage of a batch that reads
    them from an array.
    """
    mark = saved if store else lambda carry: carry
    body = rematerialized(lambda carry, row: stage(carry, materialized_arrays(row)))
    return mark(lax.scan(lambda carry, row: body(mark(carry), row), carry, stages)[0])
