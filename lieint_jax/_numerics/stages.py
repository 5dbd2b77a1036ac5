"""A loop over the stages of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from jax import lax

from lieint_jax._xla import materialized_arrays, rematerialized, saved

_Carry = TypeVar("_Carry")


def scan_stages(stage: Callable[[_Carry, Any], tuple[_Carry, None]], carry: _Carry, stages: Any) -> _Carry:
    """The last carry of a `lax.scan` of `stage` over the rows of `stages`.

    Reverse mode stores the carries between the stages, and computes each stage again. Forward, the numbers of a row are
    copied first: XLA does not vectorize a stage of a batch that reads them from an array.
    """
    body = rematerialized(lambda carry, row: stage(carry, materialized_arrays(row)))
    return saved(lax.scan(lambda carry, row: body(saved(carry), row), carry, stages)[0])
