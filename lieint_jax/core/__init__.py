"""The core types: states, steps, trajectories, groups, phase spaces and systems.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.
"""

from __future__ import annotations

from lieint_jax._discover import publish as _publish

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
