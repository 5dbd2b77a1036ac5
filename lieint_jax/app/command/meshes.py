"""Shapes of bodies for animations, from files: triangles, or parts in TOML."""

from __future__ import annotations

from functools import reduce
from operator import add
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from pydantic import Field

from lieint_jax import shapes
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._keys import Pair, PositiveFloat, PositiveTriple, Table, Triple
from lieint_jax.groups import so3
from lieint_jax.plots.solids import BodyShape, Solid, box, cylinder, ellipsoid, join
from lieint_jax.plots.solids import read as read_surface
from lieint_jax.runs import store as archives


class Part(Table):
    """A part of a body: a box, a cylinder or an ellipsoid, in the axes of the body's inertia."""

    box: PositiveTriple | None = None
    """Full lengths along x, y and z."""
    cylinder: Pair | None = None
    """Radius and full length; the axis is z."""
    ellipsoid: PositiveTriple | None = None
    """Semi-axes along x, y and z."""
    position: Triple = Field([0.0, 0.0, 0.0])
    """The position of its center."""
    euler_313_deg: Triple = Field([0.0, 0.0, 0.0])
    """Attitude R_z(α) R_x(β) R_z(γ), in degrees."""
    density: PositiveFloat = 1.0
    """Relative to other parts."""

    def _check_solid(self) -> None:
        if sum(x is not None for x in (self.box, self.cylinder, self.ellipsoid)) != 1:
            raise ValueError("give exactly one of box, cylinder and ellipsoid")

    def placed(self) -> tuple[Solid, shapes.Shape]:
        """Its surface and its moments, in the axes of the body."""
        if self.box is not None:
            solid, shape = box(np.array(self.box)), shapes.box(self.box, density=self.density)
        elif self.cylinder is not None:
            solid, shape = cylinder(*self.cylinder), shapes.cylinder(*self.cylinder, density=self.density)
        else:
            axes = np.array(self.ellipsoid)
            solid, shape = ellipsoid(axes), shapes.ellipsoid(axes, density=self.density)
        rotation = np.asarray(so3.to_matrix(so3.from_euler_313(jnp.deg2rad(jnp.array(self.euler_313_deg)))))
        return solid.moved(np.array(self.position), rotation), shape.moved(self.position, rotation)


class Parts(Table):
    """The parts of a body, which are drawn together and do not overlap."""

    parts: Annotated[list[Part], Field(min_length=1)]


def read(path: Path) -> BodyShape:
    """The shape of a body in a file .toml, or of triangles.

    Raises:
        ValueError: there is no such file, it has another ending, or it describes no solid.
    """
    if path.suffix != ".toml" or not path.is_file():
        return read_surface(path)
    table = scenarios.validate(Parts, archives.read_toml(path, str(path)), str(path))
    solids, found = zip(*(part.placed() for part in table.parts), strict=True)
    return BodyShape(path.name, join(solids), reduce(add, found))
