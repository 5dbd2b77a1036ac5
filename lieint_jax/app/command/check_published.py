"""The command `check --published`: published numbers of other codes, recomputed."""

from __future__ import annotations

from collections.abc import Iterator

from lieint_jax.app.command.compilation import use_program_cache
from lieint_jax.app.published import Case, cases


def check() -> None:
    """Run every case, and print each comparison as soon as it is computed."""
    use_program_cache()
    for case in cases():
        for line in report(case):
            print(line, flush=True)


def report(case: Case) -> Iterator[str]:
    """The lines of a case: its source, the scheme, and the largest difference in each quantity."""
    yield case.code
    yield f"  source     {case.source}"
    yield f"  scheme     {case.scheme}"
    for found in case.compare():
        digits = f", printed to {found.digits:.0e}" if found.digits else ""
        yield f"  {found.quantity:<42} differs by {found.difference:.1e}{digits}"
    yield f"  limited by {case.limit}"
    yield ""
