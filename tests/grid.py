"""The grid of systems and schemes, found by looking into the packages: no list to edit."""

import lieint_jax as li
from lieint_jax import _discover


def systems():
    for module_name, module in _discover.modules(li.systems).items():
        for name, example in module.examples().items():
            yield f"{module_name}.{name}", example


def steps():
    """(id, step, state, dt) of every system with every scheme that takes it."""
    for name, (system, state, dt) in systems():
        for module in _discover.modules(li.schemes).values():
            for step_name, step in module.examples(system).items():
                yield f"{name}-{step_name}", step, state, dt
