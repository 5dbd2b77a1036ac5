"""Calls of public functions with all their numbers, from the `examples()` of laws, potentials and orbits."""

import inspect

import jax
import numpy as np

from lieint_jax import _discover, orbits, potentials, torques

ROOMS = (torques, potentials, orbits)


def public_functions(*modules):
    """The names and the functions of modules: "torques.viscous", …"""
    for module in modules:
        for name in module.__all__:
            found = getattr(module, name)
            if inspect.isfunction(found) or (inspect.isclass(found) and name[0].islower()):
                yield f"{module.__name__.removeprefix('lieint_jax.')}.{name}", found


def examples():
    """The calls of `examples()` of all modules, by room and name: "torques.bdot with a limit", …"""
    return {
        f"{room.__name__.removeprefix('lieint_jax.')}.{name}": call
        for room in ROOMS
        for module in _discover.modules_with("examples", room).values()
        for name, call in module.examples().items()
    }


def is_number(leaf):
    """Whether a leaf of an argument is a real number, or an array of them, that a user chose."""
    return isinstance(leaf, float | np.floating) or getattr(getattr(leaf, "dtype", None), "kind", "") == "f"


def numbers(arguments):
    """The real numbers of the arguments of a call, by their places in the tree, and the tree."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(arguments)
    return {jax.tree_util.keystr(path): np.asarray(x, float) for path, x in leaves if is_number(x)}, (leaves, structure)


def with_numbers(tree, given):
    """The arguments with other numbers, by their places."""
    leaves, structure = tree
    return structure.unflatten([given.get(jax.tree_util.keystr(path), x) for path, x in leaves])
