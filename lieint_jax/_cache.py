"""The cache of compiled programs on disk: a second process starts without compiling."""

from __future__ import annotations

import hashlib
import os
import platform
import re
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

_WORTHWHILE = 0.01  # seconds of compilation below which a program is not kept


def cache_programs(path: str | os.PathLike[str] | None = None) -> Path:
    """Keep the programs that are compiled from here on, for all processes that call this: those load them.

    Turns on JAX's persistent compilation cache, for all that JAX compiles. A process still traces its functions, which
    is the smaller part of a first call. Processes may share the folder, and it may be deleted at any time.

    Args:
        path: a folder, which is made; by default `lieint` under the user's cache directory (`~/.cache` on Linux).
            Programs for different kinds of processors lie in folders of their own in it.

    Returns:
        The folder that JAX writes to.

    Raises:
        OSError: the folder cannot be made.

    Example:
        >>> import lieint_jax as li
        >>> folder = li.cache_programs()  # doctest: +SKIP
    """
    folder = (_user_folder() if path is None else Path(path).expanduser().absolute()) / _processor()
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTHWHILE)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # else JAX stays without one if it has compiled anything
    return folder


def _user_folder() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("lieint", appauthor=False)


def _processor() -> str:
    """A name for this kind of processor: home directories are shared by machines with other instruction sets."""
    try:
        features = re.search(r"(?m)^(?:flags|Features)\s*:(.*)$", Path("/proc/cpuinfo").read_text())
    except OSError:
        features = None
    known = features.group(1) if features else platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(known.encode()).hexdigest()[:8]}"
