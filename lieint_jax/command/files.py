"""The command `files`: it describes files that other software wrote."""

from __future__ import annotations

from pathlib import Path

import tyro

from lieint_jax import files
from lieint_jax.command.printer import show


def describe(paths: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Describe files that other software wrote: orbits, attitudes, shapes, molecules, light curves, logs.

    Args:
        paths: an OEM, a TLE, an OBJ, a CSV, …
    """
    if not paths:
        raise ValueError("give a file or several: lieint files FILE …")
    for path in paths:  # one by one: an error leaves those before it on the screen
        show(files.describe(path))
