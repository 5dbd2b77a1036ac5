"""A body's own shape for animations, from a file: OBJ, STL, or boxes, cylinders and ellipsoids in TOML."""

from __future__ import annotations

from functools import reduce
from operator import add
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from pydantic import Field, model_validator

from lieint_jax import shapes
from lieint_jax.app import scenarios
from lieint_jax.app.command import meshes
from lieint_jax.app.command.meshes import Solid
from lieint_jax.app.scenarios._keys import PositiveFloat, PositiveTriple, Table, Triple
from lieint_jax.groups import so3
from lieint_jax.runs import store as archives

_DISTINCT = 0.02  # difference of moments of inertia, relative to their sum, that defines principal axes


class BodyShape(NamedTuple):
    """The shape of a body in the axes of its inertia."""

    name: str  # of its file
    solid: Solid  # its surface
    shape: shapes.Shape  # its moments, at some density

    def centered(self) -> Solid:
        """The surface with the center of mass at the origin."""
        return self.solid.moved(-np.asarray(self.shape.center))

    def tilt(self, inertia: np.ndarray) -> float:
        """The largest angle in degrees, up to 90, between the principal axes of the shape and those of an inertia.

        Axes of moments that are nearly equal are not compared.
        """
        moments, axes = np.linalg.eigh(np.diag(inertia) if np.ndim(inertia) == 1 else inertia)
        own = np.asarray(self.shape.inertia)
        J = axes.T @ (np.diag(own) if own.ndim == 1 else own) @ axes
        J, moments, largest = J / np.trace(J), moments / moments.sum(), 0.0
        for i, j in ((0, 1), (0, 2), (1, 2)):
            off, difference = 2 * abs(J[i, j]), J[j, j] - J[i, i]
            if moments[j] - moments[i] > _DISTINCT and np.hypot(off, difference) > _DISTINCT:
                largest = max(largest, np.rad2deg(np.arctan2(off, difference)) / 2)
        return largest


class Part(Table):
    """A part of a body: a box, a cylinder or an ellipsoid, in the axes of the body's inertia."""

    box: PositiveTriple | None = None
    """Full lengths along x, y and z."""
    cylinder: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)] | None = None
    """Radius and full length; the axis is z."""
    ellipsoid: PositiveTriple | None = None
    """Semi-axes along x, y and z."""
    position: Triple = Field([0.0, 0.0, 0.0])
    """Of its center."""
    euler_313_deg: Triple = Field([0.0, 0.0, 0.0])
    """Attitude R_z(α) R_x(β) R_z(γ), in degrees."""
    density: PositiveFloat = 1.0
    """Relative to other parts."""

    @model_validator(mode="after")
    def _check_solid(self) -> Self:
        if sum(x is not None for x in (self.box, self.cylinder, self.ellipsoid)) != 1:
            raise ValueError("give exactly one of box, cylinder and ellipsoid")
        return self

    def placed(self) -> tuple[Solid, shapes.Shape]:
        """Its surface and its moments, in the axes of the body."""
        if self.box is not None:
            solid, shape = meshes.box(np.array(self.box)), shapes.box(self.box, density=self.density)
        elif self.cylinder is not None:
            solid, shape = meshes.cylinder(*self.cylinder), shapes.cylinder(*self.cylinder, density=self.density)
        else:
            axes = np.array(self.ellipsoid)
            solid, shape = meshes.ellipsoid(axes), shapes.ellipsoid(axes, density=self.density)
        rotation = np.asarray(so3.to_matrix(so3.from_euler_313(jnp.deg2rad(jnp.array(self.euler_313_deg)))))
        return solid.moved(np.array(self.position), rotation), shape.moved(self.position, rotation)


class Parts(Table):
    """The parts of a body, which are drawn together and do not overlap."""

    parts: Annotated[list[Part], Field(min_length=1)]


def read(path: Path) -> BodyShape:
    """The shape of a body in a file .toml, or of triangles, as `shapes.surface` reads it.

    Raises:
        ValueError: there is no such file, it has another ending, or it describes no solid.
    """
    if not path.is_file():
        raise ValueError(f"there is no file {path} with the shape of a body")
    if path.suffix == ".toml":
        table = scenarios.validate(Parts, archives.read_toml(path, str(path)), str(path))
        solids, found = zip(*(part.placed() for part in table.parts), strict=True)
        return BodyShape(path.name, meshes.join(solids), reduce(add, found))
    corners, faces = shapes.surface(path, closed=True)
    return BodyShape(path.name, meshes.colored(corners, faces.tolist()), shapes.mesh(corners, faces, density=1.0))
