"""Shapes from files of triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from lieint_jax import _checks, shapes

__all__ = ["read_shape"]


def read_shape(
    path: str | Path, *, mass: ArrayLike | None = None, density: ArrayLike | None = None, scale: float = 1.0
) -> shapes.Shape:
    """The homogeneous polyhedron of a file: mass, center, inertia and moments.

    Args:
        path: a path that ends in .obj, .stl, .ply, .txt (DAMIT) or .tab (PDS), as `shapes.surface` describes, or in one
            of these and .gz; other formats, such as .glb, .off and .3mf, are read by the package trimesh.
        mass, density: exactly one of them, a scalar; a density refers to the unit of length after scaling.
        scale: the factor from the file's unit of length to yours: 1000 from km to m.

    Raises:
        ValueError: a format that is not read, a line that is wrong, a surface that is not closed or whose faces differ
            in orientation, with the lines of these faces; and the errors of `shapes.mesh`.
        ImportError: trimesh is needed and not installed.
    """
    factor = _checks.positive("scale", scale)
    _checks.one_of(mass=mass, density=density)
    known = str(path).lower().removesuffix(".gz").endswith(shapes.ENDINGS)
    vertices, faces = shapes.surface(path, closed=True) if known else _by_trimesh(Path(path))
    try:
        return shapes.mesh(factor * vertices, faces, mass=mass, density=density)
    except ValueError as error:
        raise ValueError(f"{_checks.path_text(path)}: {error}") from error


def _by_trimesh(path: Path) -> tuple:
    """The vertices and triangles of a format that only trimesh reads."""
    shown = _checks.path_text(path)
    if not path.is_file():
        raise ValueError(f"there is no file {shown}")
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"{shown} needs the package trimesh (pip install trimesh); without it {', '.join(shapes.ENDINGS)} are read"
        ) from error
    try:
        found: Any = trimesh.load(path, force="mesh")
        found.merge_vertices()
        return found.vertices, found.faces
    except Exception as error:  # each of its readers raises its own
        raise ValueError(f"trimesh cannot read {shown}: {_checks.printable(str(error))}") from error
