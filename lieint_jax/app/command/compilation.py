"""The cache of compiled programs, by which a command starts without compilation from its second run on."""

from __future__ import annotations

import contextlib
import os

import jax

from lieint_jax._cache import cache_programs


def use_program_cache() -> None:
    """Cache compiled programs in a folder under the user's cache directory, unless the environment selects another.

    LIEINT_CACHE=0 switches the cache off, LIEINT_CACHE=FOLDER selects its folder; a folder that was given to JAX
    (JAX_COMPILATION_CACHE_DIR) has priority. Where the folder cannot be created, programs are not cached.
    """
    folder = os.environ.get("LIEINT_CACHE", "")
    if folder == "0" or jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    with contextlib.suppress(OSError):
        cache_programs(folder or None)
