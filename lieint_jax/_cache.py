"""The cache of compiled programs on disk: a second process starts without compiling."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import platform
import re
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

_WORTHWHILE = 0.01  # programs that compile in fewer seconds are not stored


def cache_programs(path: str | os.PathLike[str] | None = None) -> Path:
    """Store compiled programs on disk, so that later processes start without compiling them again.

    This enables JAX's persistent compilation cache for everything that JAX compiles. A process still traces its
    functions, which is the smaller part of a first call. Processes may share the folder, which you may delete.

    Args:
        path: a folder, which is created; by default `lieint` in the user's cache directory (`~/.cache` on Linux).
            Programs for each kind of processor are in a subfolder. Where it is read-only, its programs are loaded and
            no further ones are stored.

    Returns:
        The folder to which JAX writes.

    Raises:
        OSError: the folder cannot be created.

    Example:
        >>> import lieint_jax as li
        >>> folder = li.cache_programs()  # doctest: +SKIP
    """
    folder = (_user_folder() if path is None else Path(path).expanduser().absolute()) / _processor()
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    least = _WORTHWHILE if os.access(folder, os.W_OK) else math.inf  # JAX would warn of each program
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # otherwise JAX ignores the cache if it has already compiled a program
    return folder


def use_program_cache() -> None:
    """Call `cache_programs` as the command line does, unless the environment selects another folder or none.

    LIEINT_CACHE=0 switches the cache off, LIEINT_CACHE=FOLDER selects its folder; a folder that was given to JAX
    (JAX_COMPILATION_CACHE_DIR) has priority. Where the folder cannot be created, programs are not cached.
    """
    folder = os.environ.get("LIEINT_CACHE", "")
    if folder == "0" or jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    with contextlib.suppress(OSError):
        cache_programs(folder or None)


def _user_folder() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("lieint", appauthor=False)


def _processor() -> str:
    """A name for this kind of processor: home directories are shared by machines with other instruction sets."""
    try:
        features = re.search(r"(?m)^(?:flags|Features)\s*:(.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        features = None
    model = features.group(1) if features else platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(model.encode()).hexdigest()[:8]}"
