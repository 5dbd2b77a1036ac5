"""The command `check --published`: published numbers of other codes, recomputed."""

from __future__ import annotations

from lieint_jax.app.printer import show
from lieint_jax.app.published import cases


def check() -> None:
    """Run every case, and print its source, the scheme, and the largest difference in each quantity."""
    for case in cases():
        show(f"{case.code}\n  source     {case.source}\n  scheme     {case.scheme}")
        for found in case.compare():
            digits = f", printed to {found.digits:.0e}" if found.digits else ""
            show(f"  {found.quantity:<42} differs by {found.difference:.1e}{digits}")
        show(f"  limited by {case.limit}\n")
