"""Discovery of the modules of a package: a new group, system or scheme is one file, and there is no list to edit."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from types import ModuleType


def publish(package: str) -> list[str]:
    """Put the public names of the modules of a package, those of their `__all__`, into the package; their list.

    `__init__.pyi` says the same to type checkers and editors.
    """
    room = sys.modules[package]
    modules = modules_with("__all__", room).values()
    public = {name: vars(module)[name] for module in modules for name in module.__all__}
    vars(room).update(public)
    return sorted(public)


def public_modules(package: ModuleType) -> dict[str, ModuleType]:
    """The modules of `package` whose names have no leading underscore, by their names."""
    return {name: module for name, module in _modules(package) if not name.startswith("_")}


def modules_with(attribute: str, package: ModuleType) -> dict[str, ModuleType]:
    """The modules of `package` that define an attribute, by the names of their files.

    `examples` are in its systems or schemes, `__all__` in the modules that have public names. A file `_so3_midpoint.py`
    is called "so3_midpoint": the underscore keeps it from being hidden by its own function.
    """
    return {name.lstrip("_"): module for name, module in _modules(package) if attribute in vars(module)}


def _modules(package: ModuleType) -> list[tuple[str, ModuleType]]:
    names = [module.name for module in pkgutil.iter_modules(package.__path__)]
    return [(name, importlib.import_module(f"{package.__name__}.{name}")) for name in names]
