"""Keys that are read from files that people have: `shape`, `orbit` and `observation` may be {file = "…"}.

They are read when a scenario is loaded. Results hold the numbers that were read, so that no file chooses what is read
when they are opened.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax import dates, files, orbits
from lieint_jax.app.scenarios._keys import PositiveFloat, Table, Text
from lieint_jax.shapes import Shape
from lieint_jax.types import pytree, static

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}  # in a unit of time of a scenario
_ROWS = 20_000  # the most of a file, since results hold them
_BEYOND = 60.0  # s, by which the orbit of a TLE exceeds the run


class FromFile(Table):
    """A key that is read from a file."""

    file: Annotated[str, Field(min_length=1)]
    """Its path, from the folder of the scenario or the current one."""

    def read(self, path: Path, keys: dict[str, Any]) -> dict[str, Any]:
        """The keys that the file gives, by the other keys of the scenario or of the table in which it stands."""
        raise NotImplementedError


class ShapeFile(FromFile):
    """The inertia of a homogeneous body of triangles (OBJ, STL, PLY, DAMIT, PDS), or of a link (URDF, MJCF)."""

    mass: PositiveFloat | None = None
    """Give mass or density; a link has its own mass."""
    density: PositiveFloat | None = None
    """Refers to the unit of length after scaling."""
    scale: PositiveFloat = 1.0
    """The factor from the file's unit of length to yours: 1000 from km to m."""
    link: str | None = None
    """The link of a URDF, or the body of an MJCF."""

    def shape(self, path: Path) -> Shape:
        """The body."""
        readers = {".urdf": files.read_urdf_inertia, ".xml": files.read_mjcf_inertia}
        if (reader := readers.get(path.suffix.lower())) is not None:
            if (self.mass, self.density, self.scale) != (None, None, 1.0):
                raise ValueError("a link has its own mass and unit: leave out mass, density and scale")
            return reader(path, self.link)
        if self.link is not None:
            raise ValueError("link is for files of robots, .urdf and .xml")
        return files.read_shape(path, mass=self.mass, density=self.density, scale=self.scale)

    def read(self, path: Path, keys: dict[str, Any]) -> dict[str, Any]:
        """The tensor of inertia about the center, in the axes of the file."""
        inertia = np.asarray(self.shape(path).inertia)
        return {"inertia": inertia.tolist()}


class BodyFile(ShapeFile):
    """The mass (kg) and the principal moments (kg m², ascending) of a body: its axes are the principal ones."""

    def read(self, path: Path, keys: dict[str, Any]) -> dict[str, Any]:
        """Mass and moments."""
        shape = self.shape(path)
        moments, _ = shape.principal_axes()
        return {"mass_kg": float(shape.mass), "moments_kg_m2": np.asarray(moments).tolist()}


@pytree
class EphemerisOrbit(orbits.Table):
    """The orbit of a table about a center with the gravitational parameter `mu`, in axes of the name `frame`."""

    mu: Array
    frame: str = static(default="")


class Ephemeris(Table):
    """An orbit by a table: a cubic between two entries. Units are those of the scenario."""

    mu: PositiveFloat
    """The gravitational parameter GM of the center, in length³ per time_unit²."""
    times: list[float]
    """In time_unit, increasing."""
    positions: list[list[float]]
    """From the center of attraction."""
    velocities: list[list[float]]
    """Per time_unit."""
    frame: str = ""
    """The axes, such as "TEME", in which the Earth turns by mean sidereal time, or "EME2000"."""

    def motion(self, first: float, last: float) -> EphemerisOrbit:
        """The orbit; ValueError unless the table covers a run between these times."""
        found = orbits.table(self.times, self.positions, self.velocities)
        begin, end = self.times[0], self.times[-1]
        if not begin <= min(first, last) <= max(first, last) <= end:
            raise ValueError(f"the orbit is given from t = {begin:.6g} to {end:.6g}, the run {first:.6g} to {last:.6g}")
        return EphemerisOrbit(found.times, found.entries, jnp.asarray(self.mu), self.frame)


def given_motion(orbit: Any, ephemeris: Ephemeris | None, first: float, last: float) -> Any:
    """The orbit of the one of two keys that is given; ValueError if both or none are, or unless it covers a run."""
    if (orbit is None) == (ephemeris is None):
        raise ValueError("give either orbit or ephemeris")
    return orbit.motion() if ephemeris is None else ephemeris.motion(first, last)


class OrbitFile(FromFile):
    """The orbit of a file: OEM, TLE, OMM, or a vector table of Horizons. Its epoch is t = 0, unless you give one."""

    mu_km3_s2: PositiveFloat = orbits.EARTH_GM
    """The gravitational parameter of the center, in km³/s²; by default the Earth's."""
    unit_length: PositiveFloat = 1.0
    """The scenario's unit of length, in km."""
    satellite: str | None = None
    """The name of a satellite of a file with several TLE."""
    segment: int | None = None
    """The segment of an OEM, from 0, where they cannot be joined."""

    def read(self, path: Path, keys: dict[str, Any]) -> dict[str, Any]:
        """The table as `ephemeris`, and the epoch."""
        second, length = 1 / _seconds(keys), 1 / self.unit_length  # one second and one km in the scenario's units
        start = None if "epoch" not in keys else dates.epoch(keys["epoch"])
        found = self._table(path, start, keys.get("dt", 0.0) * keys.get("steps", 0) / second)
        t, r, v = (np.asarray(x, float) for x in (found.times, found.positions, found.velocities))
        if len(t) > _ROWS:
            raise ValueError(f"an orbit of a scenario has at most {_ROWS} entries, got {len(t)}")
        table = {
            "mu": self.mu_km3_s2 * length**3 / second**2,
            "times": ((t + (0.0 if start is None else found.epoch - start)) * second).tolist(),
            "positions": (r * length).tolist(),
            "velocities": (v * (length / second)).tolist(),
            "frame": found.frame,
        }
        return {"ephemeris": table, "epoch": str(found.epoch if start is None else start)}

    def _table(self, path: Path, start: dates.Epoch | None, length: float) -> files.OrbitTable:
        form = files.identify(path)
        if form == "OEM":
            return files.read_oem(path, segment=self.segment)
        if form == "Horizons":
            return files.read_horizons(path)
        if form not in ("TLE", "OMM"):
            raise ValueError(f"an orbit is read from OEM, TLE, OMM or Horizons; this is {form or 'none of them'}")
        read: Callable[..., files.MeanElements] = files.read_tle if form == "TLE" else files.read_omm
        elements = read(path, satellite=self.satellite)
        first = 0.0 if start is None else start - elements.epoch
        return elements.orbit((min(first, first + length) - _BEYOND, max(first, first + length) + _BEYOND))


class SatelliteOrbitFile(OrbitFile):
    """The orbit of a file for a scenario in m and s."""

    unit_length: Annotated[float, Field(ge=1e-3, le=1e-3)] = 1e-3


class ObservationFile(FromFile):
    """Observed attitudes and angular velocities as CSV: columns by their names, a row for each observation."""

    time: str = "t"
    """The column of times or of dates."""
    quaternion: Annotated[list[str], Field(min_length=4, max_length=4)] = ["qw", "qx", "qy", "qz"]
    """Four columns."""
    angular_velocity: Annotated[list[str], Field(min_length=3, max_length=3)] = ["wx", "wy", "wz"]
    """Three columns, in the axes of the body."""
    units: dict[Literal["time", "rates"], str] = {}
    """Units of time, "s", "ms", …, and of rates, "rad/s", "deg/s" or "rpm"; by default s and rad/s."""
    scalar: Literal["first", "last"] = "first"
    """Where the scalar part of the quaternion is."""
    frame: Literal["body_to_space", "space_to_body"] = "body_to_space"
    """What the quaternion maps."""
    source: Text = ""
    """A key of the table sources; by default the name of the file."""

    def read(self, path: Path, keys: dict[str, Any]) -> dict[str, Any]:
        """The observations, with times in time_unit."""
        unit = _seconds(keys)
        columns = {"time": self.time, "attitudes": self.quaternion, "rates": self.angular_velocity}
        how = {"units": self.units, "scalar": self.scalar, "frame": self.frame, "epoch": keys.get("epoch")}
        log = files.read_csv_log(path, **columns, **how)
        assert log.attitudes is not None
        assert log.rates is not None
        rows = zip(log.times.tolist(), log.attitudes.tolist(), (log.rates * unit).tolist(), strict=True)
        source = {"source": self.source or path.name}
        found = [
            {"label": f"{path.name}, {k}", "t": t / unit, "quaternion": q, "angular_velocity_rad": rate, **source}
            for k, (t, q, rate) in enumerate(rows, 1)
        ]
        return {"observation": found}


def _seconds(keys: dict[str, Any]) -> float:
    unit = keys.get("time_unit", "s")
    if unit not in SECONDS:
        raise ValueError(f"time_unit must be one of {', '.join(SECONDS)} where a file has times, got {unit!r}")
    return SECONDS[unit]
