"""Discovery of the modules of a package: a new group, system or scheme is one file, and there is no list to edit."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType


def public_modules(package: ModuleType) -> dict[str, ModuleType]:
    """The modules of `package` whose names have no leading underscore, by their names."""
    return {name: module for name, module in _modules(package) if not name.startswith("_")}


def modules_with_examples(package: ModuleType) -> dict[str, ModuleType]:
    """The modules of `package` that define `examples`, such as its systems or schemes, by the names of their files.

    A file `_so3_midpoint.py` is called "so3_midpoint": the underscore keeps it from being hidden by its own function.
    """
    return {name.lstrip("_"): module for name, module in _modules(package) if hasattr(module, "examples")}


def _modules(package: ModuleType) -> list[tuple[str, ModuleType]]:
    names = [module.name for module in pkgutil.iter_modules(package.__path__) if not module.ispkg]
    return [(name, importlib.import_module(f"{package.__name__}.{name}")) for name in names]
