"""Vector tables of JPL Horizons, and ephemerides as tables with named columns (CSV)."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lieint_jax import _checks, dates
from lieint_jax._text import Text, read_text
from lieint_jax.files import _ccsds
from lieint_jax.files._orbit_table import OrbitTable, orbit_table
from lieint_jax.files._stated_units import check_stated_units

_LENGTHS = {"km": 1.0, "m": 1e-3, "au": 149597870.7}  # km
_TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}  # s
_SPEEDS = {f"{x}/{t}": _LENGTHS[x] / _TIMES[t] for x, t in (("km", "s"), ("m", "s"), ("au", "d"), ("km", "d"))}
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_DATE = re.compile(r"A\.D\.\s+(\d{4})-([A-Z][a-z]{2})-(\d{2})(?:\s+(\d{2}:\d{2}(?::\d{2}(?:\.\d*)?)?))?(?:\s+[A-Z]+)?")
_LABELS = re.compile(r"\b[A-Z]+\s*=")
_JULIAN = re.compile(r"JD(?:TDB|TT|UT|CT)\b")
_COLUMNS = ["X", "Y", "Z", "VX", "VY", "VZ"]
_SCALES = {"CT": "TDB", "TDB": "TDB", "TT": "TT", "UT": "UTC", "UTC": "UTC"}


def read_horizons(path: str | Path) -> OrbitTable:
    """The orbit of a vector table of JPL Horizons, with or without CSV, in km and s.

    Units, axes, center and target are read from its header, the entries between $$SOE and $$EOE. The table must be of
    geometric states from the center of a body, with positions and velocities (vector table 2 or 3).

    Args:
        path: of the file; packed if its name ends in .gz.

    Returns:
        An `OrbitTable`, a function t ↦ (position, velocity).

    Raises:
        ValueError: no such table, units other than KM-S, KM-D and AU-D, a center that is a site on a body, no
            velocities, or a table that is cut short.

    Source: the manual of JPL Horizons, ssd.jpl.nasa.gov/horizons/manual.html.
    """
    text = read_text(path)
    stripped = [line.strip() for line in text.lines]
    for mark in ("$$SOE", "$$EOE"):
        if mark not in stripped:
            text.fail(0, f"the line {mark} is missing: it is no table of Horizons, or is cut short")
    start, stop = stripped.index("$$SOE"), stripped.index("$$EOE")
    header: dict[str, tuple[int, str]] = {}
    for k, line in enumerate(stripped[:start], 1):
        key, colon, value = line.partition(":")
        if colon and key.strip().lower() not in header:
            header[key.strip().lower()] = k, value.partition("{")[0].strip()
    line, word = _field(text, header, "output units")
    length, _, unit = word.split(",")[0].strip().lower().partition("-")
    if length not in ("km", "au") or unit not in ("s", "d"):
        text.fail(line, f"the units must be KM-S, KM-D or AU-D, got {_checks.printable(word)!r}")
    line, word = _field(text, header, "start time")
    scale = _SCALES.get(word.split()[-1] if word else "")
    if scale is None:
        text.fail(line, f"the scale of the times must be TDB, TT or UT, got {_checks.printable(word)!r}")
    line, word = header.get("output type", (0, "GEOMETRIC"))
    if "GEOMETRIC" not in word.upper():
        text.fail(line, f"the states must be geometric, without aberration, got {_checks.printable(word)!r}")
    line, word = header.get("center-site name", (0, "BODY CENTER"))
    if word.upper() != "BODY CENTER":
        text.fail(
            line, f"the center must be that of a body (Center-site name BODY CENTER), got {_checks.printable(word)!r}"
        )
    _check_columns(text, stripped, start)
    lines, moments, states = _records(text, stripped, start + 1, stop, scale)
    axes = "coordinate systm" if "coordinate systm" in header else "reference frame"  # of older and newer files
    names = [_field(text, header, key)[1] for key in (axes, "center body name", "target body name")]
    if "B1950" in header.get("reference frame", (0, ""))[1].upper() and "B1950" not in names[0]:
        names[0] += ", B1950"  # the epoch to which the axes of an older file refer
    times = _ccsds.elapsed(text, lines, moments)
    values = np.array(states) * np.repeat([_LENGTHS[length], _LENGTHS[length] / _TIMES[unit]], 3)
    return orbit_table(text, moments[0], times, values, names)


def _field(text: Text, header: Mapping[str, tuple[int, str]], key: str) -> tuple[int, str]:
    if key not in header:
        text.fail(0, f"the header of the table must have a line {key.capitalize()}")
    return header[key]


def _check_columns(text: Text, stripped: Sequence[str], start: int) -> None:
    """ValueError if the names of the columns, from a line JDTDB to the entries, are not those of states."""
    first = next((k for k in range(start - 1, -1, -1) if _JULIAN.match(stripped[k])), start)
    listed = " ".join(stripped[first:start]).replace("Calendar Date", "")
    names = [word for word in re.split(r"[\s,*]+", listed) if word and not re.match(r"JD|\(", word)]
    if names and names[:6] != _COLUMNS:
        shown = _checks.printable(", ".join(names[:6]))
        text.fail(
            first + 1, f"an entry must be a position and a velocity (vector table 2 or 3), it begins with {shown}"
        )


def _records(
    text: Text, stripped: Sequence[str], start: int, stop: int, scale: str
) -> tuple[list[int], list[dates.Epoch], list[list[float]]]:
    """The lines, dates and six numbers of each entry: in one line with commas, or in lines after that of the date."""
    lines: list[int] = []
    moments: list[dates.Epoch] = []
    states: list[list[float]] = []
    for k in range(start, stop):
        line = stripped[k]
        date = _DATE.search(line)
        if date:
            year, month, day, hour = date.groups()
            if month not in _MONTHS:
                text.fail(k + 1, f"the month must be one of {', '.join(_MONTHS)}, got {month!r}")
            word = f"{year}-{_MONTHS.index(month) + 1:02d}-{day}T{hour or '00:00'}"
            moments.append(_ccsds.moment(text, k + 1, word, scale))
            julian = text.number(k + 1, re.split(r"[=,]", line)[0].strip(), "the Julian date")
            if abs(julian - moments[-1].julian_date) > 1e-3:
                text.fail(k + 1, f"the date must be of the Gregorian calendar and agree with {julian}")
            lines.append(k + 1)
            states.append([])
            line = line[date.end() :].lstrip(" ,")
        elif line and not states:
            text.fail(k + 1, f"an entry must begin with a date as in A.D. 2024-Jan-01, got {_checks.printable(line)!r}")
        words = [word.strip() for word in line.split(",")] if "," in line else _LABELS.sub(" ", line).split()
        if line and len(states[-1]) < 6:
            states[-1] += text.numbers(k + 1, [word for word in words if word], "an entry")[: 6 - len(states[-1])]
    for line, state in zip(lines, states, strict=True):
        if len(state) != 6:
            text.fail(
                line, f"an entry must be a position and a velocity (vector table 2 or 3), got {len(state)} numbers"
            )
    if not states:
        text.fail(start, "the table has no entries")
    return lines, moments, states


def read_ephemeris_csv(
    path: str | Path,
    *,
    time: str,
    positions: Sequence[str],
    velocities: Sequence[str],
    unit_length: str | float,
    unit_time: str | float = "s",
    unit_velocity: float | None = None,
    epoch: str | dates.Epoch | None = None,
    frame: str = "",
    center: str = "",
    object: str = "",  # noqa: A002
) -> OrbitTable:
    """The orbit of a table with named columns (CSV): commas, semicolons or tabs; lines that begin with # are skipped.

    Args:
        path: of the file; its first line names the columns.
        time: the column of the times: numbers in `unit_time` since `epoch`, or dates, such as 2024-03-01T12:00:00.
        positions, velocities: the columns of x, y and z.
        unit_length: "km", "m", "au", or a number of km.
        unit_time: "s", "min", "h", "d", or a number of s.
        unit_velocity: in km/s; by default unit_length / unit_time.
        epoch: the date of t = 0 of times that are numbers; of dates, only its scale is used, by default UTC.
        frame, center, object: as in `OrbitTable`.

    Raises:
        ValueError: a column that the file does not have, an entry that is no number, times that do not increase, or
            velocities that are not those of the positions, as with wrong units.
    """
    length, unit = _unit("unit_length", unit_length, _LENGTHS), _unit("unit_time", unit_time, _TIMES)
    speed = length / unit if unit_velocity is None else _unit("unit_velocity", unit_velocity, {})
    if len(positions) != 3 or len(velocities) != 3:
        raise ValueError(f"positions and velocities must be three columns each, got {positions} and {velocities}")
    text = read_text(path)
    rows = [(k, line) for k, line in enumerate(text.lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        text.fail(0, "the file has no line of the names of its columns")
    delimiter = max(",;\t", key=rows[0][1].count)
    names = _cells(text, *rows[0], delimiter)
    missing = [name for name in (time, *positions, *velocities) if name not in names]
    if missing:
        text.fail(rows[0][0], f"there is no column {missing[0]!r}; the columns are {_checks.printable(names)}")
    at, *columns = (names.index(name) for name in (time, *positions, *velocities))
    for columns_of, factor, known in (
        (positions, length, _LENGTHS),
        (velocities, speed, _SPEEDS),
        ([time], unit, _TIMES),
    ):
        check_stated_units(text, rows[0][0], list(columns_of), factor, known)
    lines, moments, states = [], [], []
    for k, line in rows[1:]:
        cells = _cells(text, k, line, delimiter)
        if len(cells) != len(names):
            text.fail(k, f"a row must have {len(names)} columns, got {len(cells)}")
        lines.append(k)
        moments.append(cells[at])
        states.append(text.numbers(k, [cells[i] for i in columns], "an entry"))
    if not states:
        text.fail(rows[0][0], "the table has no entries")
    values = np.array(states) * np.repeat([length, speed], 3)
    if re.match(r"\d{4}-", moments[0]):
        scale = None if epoch is None else dates.epoch(epoch).scale
        found = [_ccsds.moment(text, k, word, scale) for k, word in zip(lines, moments, strict=True)]
        start, times = found[0], _ccsds.elapsed(text, lines, found)
    else:
        if epoch is None:
            text.fail(rows[0][0], "times are numbers: give epoch=, the date of t = 0, such as '2024-03-01 TDB'")
        found = [text.number(k, word, "a time") for k, word in zip(lines, moments, strict=True)]
        start, times = dates.epoch(epoch), _ccsds.increasing(text, lines, np.array(found), moments) * unit
    return orbit_table(text, start, times, values, (frame, center, object), units=True)


def _unit(name: str, given: str | float, known: Mapping[str, float]) -> float:
    if isinstance(given, str) and given in known:
        return known[given]
    if isinstance(given, str) or not 0 < given < np.inf:
        raise ValueError(f"{name} must be {', '.join([*map(repr, known), 'a positive number'])}, got {given!r}")
    return float(given)


def _cells(text: Text, k: int, line: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
    except csv.Error as error:
        return text.fail(k, f"the line cannot be split into columns: {error}")
