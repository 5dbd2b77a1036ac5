"""The core types: states, steps, trajectories, groups, phase spaces and systems.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.
"""

from __future__ import annotations

import importlib
from typing import Any

from lieint_jax._deprecated import warn_of_removal
from lieint_jax._discover import publish as _publish

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name.startswith("Abstract") and name in (moved := vars(importlib.import_module("lieint_jax.capabilities"))):
        warn_of_removal(f"li.types.{name} is now li.capabilities.{name}; the old name")
        return moved[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
