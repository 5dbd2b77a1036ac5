"""Orbit ephemeris messages (OEM) of the CCSDS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks, dates, orbits
from lieint_jax._text import read_text
from lieint_jax.files import _ccsds
from lieint_jax.files._orbit_table import OrbitTable, orbit_table
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractManyBodies

_FACTS = ("REF_FRAME", "CENTER_NAME", "OBJECT_NAME")
Orbit = Callable[[ArrayLike], tuple[Array, Array]]


def read_oem(path: str | Path, *, segment: int | None = None) -> OrbitTable:
    """The orbit of an orbit ephemeris message (CCSDS OEM, as text), in km and s.

    Segments are joined if they have one object, center, frame and time system, and each begins with the last row of the
    one before. Covariances are skipped and accelerations ignored. In UTC no leap seconds are counted.

    Args:
        path: of the file, version 1.0 to 3.0; packed if its name ends in .gz.
        segment: the number of the segment, from 0, where they cannot be joined.

    Returns:
        An `OrbitTable`, a function t ↦ (position, velocity).

    Raises:
        ValueError: not such a message, cut short, rows that do not increase in time, or segments that cannot be joined.

    Warns:
        UserWarning: its axes rotate, such as ITRF2014; velocities that are not those of the positions.

    Source: CCSDS 502.0-B-3, Orbit Data Messages, 2023, section 5.
    """
    text = read_text(path)
    _, segments = _ccsds.read_segments(text, "OEM")
    part = _ccsds.one_part(segments, segment, lambda found: _ccsds.rows_of(found, (6, 9), _FACTS), _same)
    return orbit_table(text, part.epoch, part.times, part.values, [part.facts[key] for key in _FACTS])


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two states agree to the digits of a file."""
    return all(np.linalg.norm(x - y) <= 1e-6 * np.linalg.norm(x) for x, y in ((a[:3], b[:3]), (a[3:], b[3:])))


def write_oem(
    path: str | Path,
    orbit: Orbit | Run,
    *,
    epoch: str | dates.Epoch | None = None,
    frame: str | None = None,
    center: str | None = None,
    object: str | None = None,  # noqa: A002
    times: npt.ArrayLike | None = None,
    body: int | None = None,
    about: int | None = None,
    unit_length: float = 1.0,
    unit_time: float = 1.0,
) -> None:
    """Write an orbit, or the motion of a body of a run, as an orbit ephemeris message (CCSDS OEM 2.0).

    Args:
        path: of the file.
        orbit: a function t ↦ (position, velocity), or a run of bodies on an orbit (`systems.gravity_gradient`) or of
            several bodies (`systems.rigid_bodies`).
        epoch: the date of t = 0, such as "2024-03-01T12:00:00 TDB".
        frame, center, object: the axes, the body at the origin and the name of what moves. An orbit that was read from
            a file has these and the epoch.
        times: the times of the rows, (n,), in the orbit's unit; by default those of the table or the run.
        body: the number of the body, from 0, in a run of several.
        about: the number of the body at the origin; by default the origin is that of space.
        unit_length: the orbit's unit of length in km, such as 1e-3 for meters.
        unit_time: its unit of time in s.

    Raises:
        ValueError: epoch, frame, center or object are known from nowhere, or the positions are.
    """
    given = {"epoch": epoch, "frame": frame, "center": center, "object": object}
    known: dict[str, Any] = {"epoch": orbit.epoch} if isinstance(orbit, Run | OrbitTable) else {}
    if isinstance(orbit, OrbitTable):
        known |= {"frame": orbit.frame, "center": orbit.center, "object": orbit.object}
    known |= {name: value for name, value in given.items() if value is not None}
    if missing := [f"{name}=" for name in given if known.get(name) is None]:
        raise ValueError(f"give {', '.join(missing)}, which this orbit does not have")
    t, r, v = (np.asarray(x, float) for x in _states(orbit, times, body, about))
    if not (t.ndim == 1 and len(t) > 1 and (np.diff(t) > 0).all() and np.isfinite(r).all() and np.isfinite(v).all()):
        raise ValueError("times must increase, at least two of them, and the orbit must be finite at all")
    t, r, v = t * unit_time, r * unit_length, v * (unit_length / unit_time)
    start = dates.epoch(known["epoch"])
    values = (known[name] for name in ("object", "object", "center", "frame"))
    meta = dict(zip(("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME"), map(str, values), strict=True))
    meta |= _ccsds.span(start, t)
    rows = (_ccsds.row(start, now, (*a, *b)) for now, a, b in zip(t.tolist(), r.tolist(), v.tolist(), strict=True))
    _ccsds.write_message(path, "OEM", "2.0", meta, rows)


def _states(
    orbit: Orbit | Run, times: npt.ArrayLike | None, body: int | None, about: int | None
) -> tuple[ArrayLike, ArrayLike, ArrayLike]:
    """Times, positions and velocities."""
    if isinstance(orbit, Run):
        if orbit.members is not None or times is not None:
            raise ValueError("give one member, run.member(k), and no times: the rows are the states of the run")
        match orbit.system:
            case object(orbit=path) if path is not None:
                return orbit.t, *jax.vmap(path)(jnp.asarray(orbit.t))
        return orbit.t, *_of_body(orbit, body, about)
    if times is None:
        if not isinstance(orbit, orbits.Table):
            raise ValueError("give times=, the times of the rows: only tables and runs have times")
        return orbit.times, orbit.positions, orbit.velocities
    t = _checks.real_array("times", times)
    if t.ndim != 1:
        raise ValueError(f"times must have shape (n,), got {t.shape}")
    if isinstance(orbit, orbits.Table) and len(t):
        for end in (t.min(), t.max()):
            orbit(end)  # refuses times outside
    return t, *jax.vmap(orbit)(t)


def _of_body(run: Run, body: int | None, about: int | None) -> tuple[np.ndarray, np.ndarray]:
    """The positions and velocities of one of several bodies, (n, 3)."""
    if not isinstance(run.system, AbstractManyBodies):
        raise ValueError(
            f"a run has positions if it is of several bodies, or of a body with an orbit, got {run.system!r}: give the "
            "orbit of its torques, and times=run.t"
        )
    m = np.asarray(run.system.masses)  # pyright: ignore[reportAttributeAccessIssue]
    for name, number in (("body", body), ("about", 0 if about is None else about)):
        if not isinstance(number, int) or not 0 <= number < len(m):
            raise ValueError(f"{name} must be the number of a body, 0 to {len(m) - 1}, got {number}")
    x, v = np.asarray(run.state.q)[..., :3], np.asarray(run.state.p)[..., :3] / m[:, None]
    return tuple(y[:, body] - (0 if about is None else y[:, about]) for y in (x, v))  # pyright: ignore[reportReturnType]
