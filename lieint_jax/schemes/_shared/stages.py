"""Steps one after the other, as the stages of one step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

from lieint_jax._numerics.stages import scan_stages
from lieint_jax.core import StepInfo

_Carry = TypeVar("_Carry")


def compose_stages(
    substep: Callable[..., tuple[_Carry, StepInfo]], start: _Carry, rows: tuple[Any, ...], store: bool = True
) -> tuple[_Carry, StepInfo]:
    """`start` after substep(z, *row) ↦ (z, report) for each row of some arrays, and the merged report."""

    def stage(carry: tuple[_Carry, StepInfo], row: tuple[Any, ...]) -> tuple[tuple[_Carry, StepInfo], None]:
        z, info = substep(carry[0], *row)
        return (z, carry[1].merge(info)), None

    return scan_stages(stage, (start, StepInfo.empty(jax.tree.leaves(start)[0])), rows, store)
