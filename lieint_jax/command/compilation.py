"""The cache of compiled programs: the second `lieint run` of a kind starts without compiling."""

from __future__ import annotations

import hashlib
import os
import platform
import re
from pathlib import Path

import jax
from platformdirs import user_cache_path

_WORTHWHILE = 0.01  # seconds of compilation below which a program is not kept


def keep_programs() -> None:
    """Keep compiled programs in a folder under the user's cache directory, unless the user has said otherwise.

    LIEINT_CACHE=0 in the environment turns it off, LIEINT_CACHE=FOLDER keeps them there; a folder that JAX was given
    (JAX_COMPILATION_CACHE_DIR) stays. Programs of different kinds of processor lie in different folders.
    """
    folder = os.environ.get("LIEINT_CACHE", "")
    if folder == "0" or jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    root = Path(folder) if folder else user_cache_path("lieint", appauthor=False)
    jax.config.update("jax_compilation_cache_dir", str(root / _processor()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTHWHILE)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _processor() -> str:
    """A name for this kind of processor: home directories are shared by machines with other instruction sets."""
    try:
        features = re.search(r"(?m)^(?:flags|Features)\s*:(.*)$", Path("/proc/cpuinfo").read_text())
    except OSError:
        features = None
    known = features.group(1) if features else platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(known.encode()).hexdigest()[:8]}"
