"""What a file of other software is, and what can be done with it."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lieint_jax import shapes
from lieint_jax._checks import path_text, printable
from lieint_jax._text import read_text
from lieint_jax.files._aem import read_aem
from lieint_jax.files._horizons import read_horizons
from lieint_jax.files._identify import identify
from lieint_jax.files._light_curves import read_light_curves
from lieint_jax.files._molecules import read_molecules
from lieint_jax.files._oem import read_oem
from lieint_jax.files._orbit_table import OrbitTable
from lieint_jax.files._shapes import read_shape
from lieint_jax.files._tle import MeanElements, read_omm, read_tle

__all__ = ["describe"]

_COLUMNS = 20  # the most that are listed


class Format(NamedTuple):
    """A format of files of other software."""

    what: str  # it holds, in words
    contents: Callable[[Path], list[str]]  # the lines that describe a file
    reader: str  # the call that reads it in Python, with {} for the file


def describe(path: str | PathLike[str]) -> str:
    """What a file is, what is in it, and what reads it, as text: `lieint files` prints it.

    Args:
        path: a file of one of the formats of `li.files`.

    Raises:
        ValueError: a file of none of the formats, or what is wrong with it.
    """
    path = Path(path)
    form = identify(path)
    if form not in FORMATS:
        known = ", ".join(FORMATS)
        raise ValueError(
            f"{path_text(path)} has none of the formats {known}; lieint run runs a script, NAME.py, and lieint info "
            "describes its results, NAME.zarr"
        )
    what, contents, reader = FORMATS[form]
    name = path_text(path.name)
    lines = [f"{path_text(path)}: {what}", *contents(path), "in Python: li.files." + reader.replace("{}", f'"{name}"')]
    return "\n  ".join(lines)


def _orbit(read: Callable[[Path], OrbitTable]) -> Callable[[Path], list[str]]:
    def contents(path: Path) -> list[str]:
        found = read(path)
        t, r = np.asarray(found.times), np.linalg.norm(np.asarray(found.positions), axis=1)
        return [
            f"{printable(found.object)} about {printable(found.center)}, axes {printable(found.frame)}",
            f"{len(t)} states from {found.epoch} over {t[-1] - t[0]:.6g} s, {r.min():.6g} to {r.max():.6g} km away",
        ]

    return contents


def _attitudes(path: Path) -> list[str]:
    found = read_aem(path)
    frames = f"axes {printable(found.frame_b)} of the body in {printable(found.frame_a)}"
    span = f"{len(found.times)} attitudes from {found.epoch} over {found.times[-1] - found.times[0]:.6g} s"
    return [f"{printable(found.object)}, {frames}", span + (", with rates" if found.rates is not None else "")]


def _elements(read: Callable[[Path], MeanElements]) -> Callable[[Path], list[str]]:
    def contents(path: Path) -> list[str]:
        found = read(path)
        e = found.elements
        shape = f"{e.mean_motion:.6g} revolutions a day, eccentricity {e.eccentricity:.4g}, {e.inclination:.4g}°"
        return [f"{printable(found.name)}, mean elements of {found.epoch}: {shape}"]

    return contents


def _surface(path: Path) -> list[str]:
    corners, _ = shapes.surface(path)
    body = read_shape(path, density=1.0)
    moments = np.asarray(body.principal_axes()[0]) / float(body.mass)
    assert body.triangles is not None
    size = " × ".join(f"{x:.4g}" for x in np.ptp(corners, axis=0))
    return [
        f"{len(corners)} vertices, {len(body.triangles)} triangles, {size}, volume {float(body.mass):.6g}",
        f"principal moments over the mass {moments[0]:.6g}, {moments[1]:.6g}, {moments[2]:.6g}, in the file's unit²",
    ]


def _molecules(path: Path) -> list[str]:
    found = read_molecules(path)
    return [f"{len(found)} molecule(s), the first of {len(found[0].names)} atoms and {found[0].masses.sum():.6g} u"]


def _curves(path: Path) -> list[str]:
    found = read_light_curves(path)
    first, last = (f(f(curve.dates) for curve in found) for f in (min, max))
    return [f"{len(found)} curve(s) of {sum(len(c.dates) for c in found)} points, JD {first:.5f} to {last:.5f}"]


def _table(path: Path) -> list[str]:
    rows = [line for line in read_text(path).lines if line.strip() and not line.lstrip().startswith("#")]
    names = [name.strip() for name in rows[0].replace(";", ",").replace("\t", ",").split(",")]
    more = f" and {len(names) - _COLUMNS} more" if len(names) > _COLUMNS else ""
    return [f"{len(rows) - 1} rows of {', '.join(map(printable, names[:_COLUMNS]))}{more}"]


def _robot(path: Path) -> list[str]:
    return ["masses, centers and inertias of its links"]


FORMATS = {
    "OEM": Format("an orbit, CCSDS OEM", _orbit(read_oem), "read_oem({})"),
    "AEM": Format("attitudes, CCSDS AEM", _attitudes, "read_aem({})"),
    "TLE": Format("mean elements of SGP4, TLE", _elements(read_tle), "read_tle({})"),
    "OMM": Format("mean elements of SGP4, CCSDS OMM", _elements(read_omm), "read_omm({})"),
    "Horizons": Format("an orbit of JPL Horizons", _orbit(read_horizons), "read_horizons({})"),
    "shape": Format("a surface of triangles", _surface, "read_shape({}, density=…)"),
    "URDF": Format("a robot, URDF", _robot, "read_urdf_inertia({}, link)"),
    "MJCF": Format("a robot, MJCF", _robot, "read_mjcf_inertia({}, body)"),
    "PDB": Format("molecules, PDB", _molecules, "read_molecules({})"),
    "xyz": Format("a molecule, xyz", _molecules, "read_molecules({})"),
    "light curves": Format("light curves", _curves, "read_light_curves({})"),
    "table": Format("a table of text", _table, "read_csv_log({}, time=…, rates=[…])"),
}
