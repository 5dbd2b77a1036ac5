"""The grid of systems and schemes, found by looking into the packages: no list to edit."""

import functools

import lieint_jax as li
from lieint_jax import _discover


@functools.cache
def systems():
    """(id, (system, state, dt)) of every example of a system."""
    found = []
    for module_name, module in _discover.modules(li.systems).items():
        found += [(f"{module_name}.{name}", example) for name, example in module.examples().items()]
    return found


@functools.cache
def steps():
    """(id, step, state, dt) of every system with every scheme that takes it, the state as the scheme starts it."""
    found = []
    for name, (system, state, dt) in systems():
        for module in _discover.modules(li.schemes).values():
            for step_name, step in module.examples(system).items():
                found.append((f"{name}-{step_name}", step, step.start(state), dt))
    return found
