"""The grid of systems and schemes, found by looking into the packages: no list to edit."""

import functools

import lieint_jax as li
from lieint_jax import _discover


def examples_of(module):
    """The examples of a module of systems, such as "heavy_top", by their names: (system, state, dt)."""
    return _discover.modules_with("examples", li.systems)[module].examples()


@functools.cache
def systems():
    """(id, (system, state, dt)) of every example of a system."""
    found = []
    for module in _discover.modules_with("examples", li.systems):
        found += [(f"{module}.{name}", example) for name, example in examples_of(module).items()]
    return found


def examples(system):
    """The steps of a system by every scheme that takes it, by the name of the scheme's module and of the step."""
    return {
        (module_name, name): step
        for module_name, module in _discover.modules_with("examples", li.schemes).items()
        for name, step in module.examples(system).items()
    }


@functools.cache
def cases():
    """(module of the scheme, id, step, state, dt) of every system with every scheme that accepts it."""
    return [
        (module, f"{name}-{step_name}", step, step.start(state), dt)
        for name, (system, state, dt) in systems()
        for (module, step_name), step in examples(system).items()
    ]


def steps():
    """(id, step, state, dt) of every system with every scheme that takes it, the state as the scheme starts it."""
    return [found for _, *found in cases()]


def schemes():
    """The modules of the schemes that have a step of some system."""
    return {module for module, *_ in cases()}
