"""Results on disk. Nothing that is already there is ever overwritten."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lieint_jax.types import State, StepInfo, Trajectory


def free(path: Path, kinds: Iterable[str] = ()) -> Path:
    """`path`, which must end in .npz; neither it nor its pictures may exist, and its folder must be writable."""
    if path.suffix != ".npz":
        raise ValueError(f"results are written as .npz, got {path}")
    for file in (path, *pictures(path, kinds)):
        if file.exists():
            raise ValueError(f"{file} exists and is not overwritten; move it away or choose another --out")
    if not path.parent.is_dir():
        raise ValueError(f"the folder {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"the folder {path.parent} cannot be written to; choose another --out")
    return path


def pictures(path: Path, kinds: Iterable[str]) -> list[Path]:
    """Where the pictures beside results at `path` go, such as NAME-path.png of the kind "path"."""
    return [path.with_name(f"{path.stem}-{kind}.png") for kind in kinds]


def save(path: Path, trajectory: Trajectory, metadata: dict[str, Any]) -> None:
    """Write a trajectory: arrays t, q, p, residual, converged, and `metadata` as JSON text."""
    with path.open("xb") as file:
        np.savez(
            file,
            t=trajectory.t,
            q=trajectory.state.q,
            p=trajectory.state.p,
            residual=trajectory.info.residual,
            converged=trajectory.info.converged,
            metadata=np.array(json.dumps(metadata)),
        )


def load(path: Path) -> tuple[Trajectory, dict[str, Any]]:
    """What `save` wrote."""
    with np.load(path) as f:
        state, info = State(f["q"], f["p"]), StepInfo(f["residual"], f["converged"])
        return Trajectory(f["t"], state, info), json.loads(str(f["metadata"]))
