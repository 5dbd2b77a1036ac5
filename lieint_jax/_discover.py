"""Discovery of the modules of a package: a new group, system or scheme is one file, without a list to edit."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType


def modules(package: ModuleType) -> dict[str, ModuleType]:
    """The public modules of `package`, by their short names."""
    names = [module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")]
    return {name: importlib.import_module(f"{package.__name__}.{name}") for name in names}
