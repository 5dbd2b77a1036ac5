"""The second `lieint run` of a kind starts without compiling."""

from __future__ import annotations

import contextlib
import os

import jax

from lieint_jax._cache import cache_programs


def keep_programs() -> None:
    """Keep compiled programs in a folder under the user's cache directory, unless the user has said otherwise.

    LIEINT_CACHE=0 in the environment turns it off, LIEINT_CACHE=FOLDER keeps them there; a folder that JAX was given
    (JAX_COMPILATION_CACHE_DIR) stays. A folder that cannot be made is done without.
    """
    folder = os.environ.get("LIEINT_CACHE", "")
    if folder == "0" or jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    with contextlib.suppress(OSError):
        cache_programs(folder or None)
