"""Logs of times, rates and attitudes as tables of text (CSV), and runs written as such."""

from __future__ import annotations

import csv
import difflib
import itertools
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks, dates
from lieint_jax._text import Text, read_text
from lieint_jax.attitude import Frame
from lieint_jax.core import State, Step
from lieint_jax.dates import Epoch
from lieint_jax.files import _ccsds
from lieint_jax.files._signs import join_signs
from lieint_jax.files._stated_units import check_stated_units
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractRotatingBody

Column = str | int
_UNITS = {  # how many of them a second has; radians per second
    "time": {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9},
    "rates": {"rad/s": 1.0, "deg/s": np.pi / 180, "rpm": np.pi / 30},
}
_DATE, _VALUE = re.compile(r"\d{4}-\d"), re.compile(r"[+-]?\.?\d|[+-]?(nan|inf(inity)?)$", re.IGNORECASE)
_SHOWN, _SEARCHED = 40, 10_000  # the most columns that a message lists, and among which it guesses


class Log(NamedTuple):
    """A log that `read_csv_log` has read.

    Attributes:
        times: seconds, ascending, (n,).
        rates: angular velocities, radians per second, in the axes of the file, (n, 3), or None.
        attitudes: unit quaternions (w, x, y, z), body to space, without jumps of sign, (n, 4), or None.
        epoch: the date of time 0, or None.
    """

    times: np.ndarray
    rates: np.ndarray | None
    attitudes: np.ndarray | None
    epoch: Epoch | None


def read_csv_log(
    path: str | Path,
    *,
    time: Column,
    rates: Sequence[Column] | None = None,
    attitudes: Sequence[Column] | None = None,
    units: Mapping[str, str] | None = None,
    scalar: Literal["first", "last"] = "first",
    frame: Frame = "body_to_space",
    delimiter: str | None = None,
    epoch: Any = None,
    member: int | None = None,
) -> Log:
    """Read times, and rates or attitudes or both, from a table of text, such as the log of a gyro or a star tracker.

    Rows may be uneven in time. Empty lines and lines that begin with # are skipped; columns that are not asked for may
    hold anything. A file whose name ends in .gz is unpacked.

    Args:
        path: the file, UTF-8.
        time: the column of times: its name in the first row, or its index, counted from 0. Times are numbers, or dates
            as in `li.dates.epoch`.
        rates: the three columns of the angular velocity.
        attitudes: the four columns of the quaternion, in the order of the file.
        units: of "time": "s" (by default), "ms", "us", "ns"; of "rates": "rad/s" (by default), "deg/s", "rpm".
        scalar: whether the scalar part of the quaternions is "first" or "last".
        frame: as in `li.attitude`: what rotation the quaternions are.
        delimiter: what separates cells, " " for any white space; by default the tab, semicolon, comma or white space of
            the first row.
        epoch: the date of time 0, as in `li.dates.epoch`; of a column of dates by default its first one.
        member: of a file of several members, with a column "member", the one to read.

    Returns:
        A `Log` of arrays in double precision.

    Raises:
        ValueError: what is wrong with the file, with its line: no such column, one whose name ends in another unit than
            that of `units`, such as [deg/s], a cell that is empty, NaN or no number, a decimal comma, a row of another
            length, times that do not increase, a quaternion whose norm is off 1 by more than 1e-4, no rows.

    Warns:
        RuntimeWarning: quaternions with few digits, off unit length by more than 1e-6, are normalized.
    """
    asked = {"time": [time], "rates": rates, "attitudes": attitudes, "member": None if member is None else ["member"]}
    columns = {what: _columns(what, given) for what, given in asked.items() if given is not None}
    if not {"rates", "attitudes"} & set(columns):
        raise ValueError("give the columns of rates, of attitudes, or of both")
    if units is not None and not isinstance(units, Mapping):
        raise ValueError(f"units must be as in {{'time': 's', 'rates': 'deg/s'}}, got {_checks.printable(units)}")
    given = {"time": "s", "rates": "rad/s"} | dict(units or {})
    known = [_UNITS[_checks.choice("a key of units", what, _UNITS)] for what in given]
    factors = [
        table[_checks.choice(f"units of {what}", given[what], table)] for what, table in zip(given, known, strict=True)
    ]
    _checks.choice("scalar", scalar, ("first", "last"))
    _checks.choice("frame", frame, get_args(Frame))
    clock = _Clock(None if epoch is None else dates.epoch(epoch), factors[0], "time" in (units or {}))
    text = read_text(path)
    lines, values = _numbers(text, delimiter, columns, clock, member, dict(zip(given, factors, strict=True)))
    ends = np.cumsum([len(given) for given in columns.values()])
    found = dict(zip(columns, np.split(values, ends[:-1], axis=1), strict=True))
    q = found.get("attitudes")
    return Log(
        found["time"][:, 0],
        found["rates"] * factors[1] if "rates" in found else None,
        None if q is None else _attitudes(text, lines, q if scalar == "first" else np.roll(q, 1, axis=1), frame),
        clock.epoch,
    )


def _columns(what: str, given: Any) -> list[Column]:
    """The columns of an argument, as many as it needs."""
    columns = list(given) if isinstance(given, list | tuple | np.ndarray) else [given]
    count = {"rates": 3, "attitudes": 4}.get(what, 1)
    for column in columns:
        index = isinstance(column, int | np.integer) and not isinstance(column, bool) and column >= 0
        if not index and not isinstance(column, str):
            raise ValueError(f"a column of {what} must be a name or an index, counted from 0, got {column!r}")
    if len(columns) != count or len(set(columns)) != count:
        raise ValueError(f"{what} must be {count} different columns, got {columns}")
    return columns


class _Clock:
    """Seconds from the cells of a column of times, which must increase."""

    def __init__(self, epoch: Epoch | None, divisor: float, has_unit: bool) -> None:
        self.epoch, self.divisor, self.has_unit = epoch, divisor, has_unit
        self.dated: bool | None = None
        self.last, self.line = -math.inf, 0

    def seconds(self, text: Text, line: int, cell: str, hint: str) -> float:
        """The time of a row."""
        if self.dated is None:
            self.dated = bool(_DATE.match(cell))
        t = self._since_epoch(text, line, cell) if self.dated else _number(text, line, cell, "time") / self.divisor
        if not t > self.last:
            text.fail(line, f"times must increase, got {t:.9g} s after {self.last:.9g} s of line {self.line}{hint}")
        self.last, self.line = t, line
        return t

    def _since_epoch(self, text: Text, line: int, cell: str) -> float:
        if self.has_unit:
            text.fail(line, f"the times are dates, such as {_checks.printable(cell)!r}, which have no unit")
        date = _ccsds.moment(text, line, cell, None)
        try:
            self.epoch = date if self.epoch is None else self.epoch
            return date - self.epoch
        except ValueError as error:
            text.fail(line, str(error))


def _numbers(
    text: Text,
    delimiter: str | None,
    columns: dict[str, list[Column]],
    clock: _Clock,
    member: int | None,
    factors: Mapping[str, float],
) -> tuple[Sequence[int], np.ndarray]:
    """The lines of the rows, and the numbers in the columns, (rows, columns), times in seconds."""
    wanted = [column for given in columns.values() for column in given]
    names, width, rows = _header(text, _rows(text, delimiter), wanted)
    places = [_place(text, names, width, column) for column in wanted]
    if names and len(names) == width:
        for what, factor in factors.items():
            stated = [names[_place(text, names, width, column)] for column in columns.get(what, [])]
            check_stated_units(text, 0, stated, factor, _UNITS[what])
    labels = [f"{what} ({column})" for what, given in columns.items() for column in given]
    hint = "; the file has a column member: give member=" if member is None and names and "member" in names else ""
    lines, values = array("L"), array("d")
    for line, cells in rows:
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if len(cells) != width:
            text.fail(line, f"there are {len(cells)} cells for {width} columns; numbers need points, not commas")
        chosen = [cells[k] for k in places]
        if member is not None and _number(text, line, chosen[-1], "member") != member:
            continue
        lines.append(line)
        values.append(clock.seconds(text, line, chosen[0], hint))
        values.extend(_number(text, line, x, what) for x, what in zip(chosen[1:], labels[1:], strict=True))
    if not lines:
        text.fail(0, "there are no rows" if member is None else f"there are no rows of member {member}")
    return lines, np.array(values).reshape(len(lines), -1)


def _rows(text: Text, delimiter: str | None) -> Iterator[tuple[int, list[str]]]:
    """The lines of the rows and their cells. The first one is the last comment before the first row, or empty."""
    if delimiter is not None and not re.fullmatch(r"[^\w\"'.+#-]", delimiter):
        raise ValueError(f"delimiter must be one character such as ',', ';' or ' ' for white space, got {delimiter!r}")
    comment, started = "", False
    for line, content in enumerate(text.lines, 1):
        if content.lstrip().startswith("#"):
            comment = content.lstrip("# \t")
        elif line == 1 and (found := re.fullmatch(r"sep=(.)", content)):  # a hint for Excel
            delimiter = delimiter or found[1]
        elif content.strip():
            if delimiter is None:
                delimiter = next((x for x in "\t;," if x in content), " ")
            if not started:
                yield 0, [cell.strip(' \t"') for cell in comment.split(None if delimiter == " " else delimiter)]
            started = True
            yield line, _cells(text, line, content, delimiter)


def _cells(text: Text, line: int, content: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return content.split()
    try:
        [cells] = csv.reader([content], delimiter=delimiter, skipinitialspace=True, strict=True)
        return [cell.strip() for cell in cells]
    except csv.Error as error:
        text.fail(line, f"the cells cannot be separated: {error}")


def _header(
    text: Text, rows: Iterator[tuple[int, list[str]]], wanted: list[Column]
) -> tuple[list[str] | None, int, Iterator[tuple[int, list[str]]]]:
    """The names of the columns, their number, and the rows of numbers.

    Names are in the first row, or, if that has numbers only, in the comment before it, as numpy writes them. If columns
    are given by index, the first row has names if its time is no value.
    """
    (_, comment), (line, first) = next(rows, (0, [])), next(rows, (0, []))
    if not line:
        text.fail(0, "there are no rows")
    if any(isinstance(column, str) for column in wanted):
        if all(_VALUE.match(cell) for cell in first if cell):
            return comment if len(comment) == len(first) else None, len(first), itertools.chain([(line, first)], rows)
        return first, len(first), rows
    time = int(wanted[0])
    if time < len(first) and _VALUE.match(first[time]):
        return None, len(first), itertools.chain([(line, first)], rows)
    line, second = next(rows, (0, first))
    return first, len(second), itertools.chain([(line, second)] if line else [], rows)


def _place(text: Text, names: list[str] | None, width: int, column: Column) -> int:
    """The index of a column."""
    if not isinstance(column, str):
        if column >= width:
            text.fail(0, f"there is no column {column}: there are {width}, counted from 0")
        return int(column)
    if not names:
        text.fail(0, f"the columns have no names, and {column!r} was asked for: give indices, counted from 0")
    if names.count(column) > 1:
        text.fail(0, f"there are {names.count(column)} columns {column!r}: give the index, counted from 0")
    if column in names:
        return names.index(column)
    near = difflib.get_close_matches(column, names[:_SEARCHED], 1, 0.5)
    guess = f"did you mean {_checks.printable(near[0])!r}? " if near else ""
    shown = ", ".join(_checks.printable(name, 40) for name in names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")
    return text.fail(0, f"there is no column {column!r}; {guess}The columns are {shown}")


def _number(text: Text, line: int, cell: str, what: str) -> float:
    try:
        value = float(cell)
        if math.isfinite(value) and "_" not in cell:
            return value
    except ValueError:
        if not cell:
            text.fail(line, f"{what} is missing: the cell is empty")
        if re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", cell):
            text.fail(line, f"{what} must have a decimal point, got {cell[:40]!r}")
    return text.number(line, cell, what)


def _attitudes(text: Text, lines: Sequence[int], q: np.ndarray, frame: Frame) -> np.ndarray:
    """Quaternions of unit length without jumps of sign, body to space."""
    norms = np.linalg.norm(q, axis=1)
    worst = int(np.argmax(np.abs(norms - 1)))
    if abs(norms[worst] - 1) > _checks.PRINTED:
        text.fail(
            lines[worst],
            f"attitudes must be unit quaternions, got the norm {norms[worst]:.9g}; allowed is 1 ± {_checks.PRINTED:g}",
        )
    q = join_signs(_checks.nearly_unit(f"{_checks.printable(text.name)}: attitudes", q))
    if frame == "space_to_body":
        q[:, 1:] *= -1
    return q


def write_csv(path: str | Path, run: Run) -> None:
    """Write times, attitudes and angular velocities of a run, to the last bit, as a table of text with names.

    The columns are time, member (of a run of several members, of which each has its rows one after another), q_w, q_x,
    q_y, q_z (body to space) and angular_velocity_x, …_y, …_z (along the axes of the body).

    Args:
        path: the file, packed if its name ends in .gz; an existing one is replaced.
        run: of one rigid body, or of members of it.

    Raises:
        ValueError: the run is of another system, or has no states.

    Example: the log of a run, and what is read from it.
        >>> import os, tempfile, lieint_jax as li
        >>> body = li.systems.rigid_body([1.0, 2.0, 3.0])
        >>> start = body.state(angular_velocity=[0.0, 0.5, 0.0])
        >>> run = li.run(li.schemes.so3_midpoint(body), start, dt=0.5, num_steps=4)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "run.csv")
        ...     write_csv(path, run)
        ...     log = read_csv_log(path, time="time", rates=[f"angular_velocity_{x}" for x in "xyz"])
        >>> print(log.times, log.rates[0])
        [0.  0.5 1.  1.5 2. ] [0.  0.5 0. ]
    """
    if not isinstance(run, Run) or not isinstance(run.system, AbstractRotatingBody):
        raise ValueError(f"write_csv writes runs of one rigid body, as li.run returns, got {run!r}")
    numbers = np.asarray(run.map(_attitude_and_rate), float)
    times = np.asarray(run.t if run.state.t is None else run.state.t, float)
    members = numbers.ndim == 3
    if members:
        numbers = np.swapaxes(numbers, 0, 1)
        times = np.broadcast_to(times.T, numbers.shape[:2])
    columns = [times, *[np.indices(times.shape)[0]] * members, *np.moveaxis(numbers, -1, 0)]
    table = np.stack(columns, axis=-1).reshape(-1, len(columns))
    names = ["time", *["member"] * members, *(f"q_{x}" for x in "wxyz"), *(f"angular_velocity_{x}" for x in "xyz")]
    formats = ["%r", *["%d"] * members, *["%r"] * 7]
    np.savetxt(path, table.astype(object), formats, ",", header=",".join(names), comments="", encoding="utf-8")


def _attitude_and_rate(step: Step, state: State) -> Array:
    """q and the angular velocity in the body, (7,)."""
    q = state.q if state.q.ndim == 1 else so3.from_matrix(state.q)
    return jnp.concatenate([q, cast("Any", step.system).angular_velocity(state)])
