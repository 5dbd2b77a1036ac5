"""The pairs of a system and a scheme, an example of each, and what a fresh process finds of one."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any


def pairs(only: tuple[str, ...] = ()) -> Iterator[tuple[str, str, str]]:
    """The names of a system, a scheme and the first step that it makes; of all systems, or of those named."""
    import jax

    import lieint_jax as li
    from lieint_jax import _discover

    jax.config.update("jax_enable_x64", True)
    for name, module in _discover.modules_with("examples", li.systems).items():
        if only and name not in only:
            continue
        systems = [system for system, _, _ in module.examples().values()]
        for scheme, schemes in _discover.modules_with("examples", li.schemes).items():
            steps = [step for system in systems for step in schemes.examples(system).values()]
            if steps:
                yield name, scheme, steps[0].name


def example(system: str, scheme: str, name: str) -> tuple[Any, Any, float]:
    """The step of these names, a state and Δt."""
    import jax

    import lieint_jax as li
    from lieint_jax import _discover

    jax.config.update("jax_enable_x64", True)
    examples = _discover.modules_with("examples", li.systems)[system].examples().values()
    schemes = _discover.modules_with("examples", li.schemes)[scheme]
    return next(
        (step, step.start(state), dt)
        for body, state, dt in examples
        for step in schemes.examples(body).values()
        if step.name == name
    )


def in_a_process(file: str, *names: str) -> dict[str, Any]:
    """What a benchmark prints for its option --one, in a process that has compiled nothing."""
    run = subprocess.run([sys.executable, file, "--one", *names], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(run.stdout)
