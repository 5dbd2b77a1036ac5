"""The grid of systems and schemes, found by looking into the packages: no list to edit."""

import functools
import re

import lieint_jax as li
from lieint_jax import _discover

DECLARED = {entry.name: entry.conserves for entry in li.schemes.catalogue()}


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


def declares(scheme, name, invariant):
    """Whether the scheme declares it conserved; where that depends on the kind of step, the brackets name the kind."""
    step = name.partition("-")[2]
    base = re.search(r"\((\w+)", step)
    declared = DECLARED[base[1] if scheme == "compose" and base[1] in DECLARED else scheme]
    kind = step.rpartition("[")[2].rstrip("])")
    names = {text.split()[0]: text.partition("(")[2] for text in declared}
    if invariant not in names or ("free body" in names[invariant] and not name.startswith("rigid_body.")):
        return False
    return not names[invariant] or kind in re.findall(r"\w+", names[invariant])
