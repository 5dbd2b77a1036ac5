"""Python files of a user, whose kinds of scenarios and studies are imported."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType


def import_file(path: Path, name: str) -> ModuleType:
    """The module `name` of a file; ValueError with the line of whatever fails in it."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # where annotations are looked up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        lines = [x.lineno for x in traceback.extract_tb(error.__traceback__) if x.filename == str(path.absolute())]
        if isinstance(error, SyntaxError):
            lines.append(error.lineno)
        raise ValueError(f"{path}, line {lines[-1] if lines else '?'}: {type(error).__name__}: {error}") from error
    return module
