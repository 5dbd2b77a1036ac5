"""Light curves of asteroids from files of DAMIT and ALCDEF."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lieint_jax import _checks, dates
from lieint_jax._text import Text, read_text

__all__ = ["LightCurve", "read_light_curve", "read_light_curves"]

_DELIMITERS = {"": "|", "PIPE": "|", "TAB": "\t"}


@dataclasses.dataclass(frozen=True)
class LightCurve:
    """The brightness of a body at dates, in time order or not, as the file has it.

    Attributes:
        dates: Julian dates, (n,).
        scale: "UTC" in ALCDEF; "" in DAMIT, whose files do not state it.
        light_time_corrected: whether the dates are those at which the light left the body.
        brightness: (n,), magnitudes or intensities.
        magnitudes: which of both.
        errors: the standard error of each, (n,), or None.
        calibrated: False if the brightness has an unknown factor, or magnitudes an unknown constant.
        sun, observer: the vectors from the body to the Sun and the observer, (n, 3), in au, along the axes of the
            ecliptic of J2000, or None: `measure.brightness` takes them as directions in space.
        metadata: what else the file states of this curve.
    """

    dates: np.ndarray
    scale: str
    light_time_corrected: bool
    brightness: np.ndarray
    magnitudes: bool
    errors: np.ndarray | None
    calibrated: bool
    sun: np.ndarray | None
    observer: np.ndarray | None
    metadata: dict[str, str]

    @property
    def intensity(self) -> np.ndarray:
        """The brightness as intensity, (n,): 10^(−0.4 m) of magnitudes m."""
        return 10 ** (-0.4 * self.brightness) if self.magnitudes else self.brightness


def read_light_curves(path: str | Path) -> list[LightCurve]:
    """The light curves of a file, of DAMIT (lc.txt, lc.json) or ALCDEF, which its contents tell.

    Intensities of calibrated curves of DAMIT are reduced to 1 au from Sun and observer. Magnitudes of ALCDEF are as
    they are written: whether they are differential, reduced or shifted is in `metadata` (DIFFERMAGS, REDUCEDMAGS,
    MAGADJUST), its keys in capitals.

    Raises:
        ValueError: another format, a number of curves or points that is not right, or a line that is wrong.
    """
    text = read_text(path)
    start = next((line.strip() for line in text.lines if line.strip()), "")
    if start[:1] in ("[", "{"):
        found = list(_from_json(text))
    elif any(line.strip().upper() == "STARTMETADATA" for line in text.lines):
        found = list(_from_alcdef(text))
    else:
        found = _from_plain(text)
    if not found:
        text.fail(0, "there is no light curve")
    return found


def read_light_curve(path: str | Path, *, number: int | None = None) -> LightCurve:
    """One light curve of a file, as `read_light_curves` reads them.

    Args:
        path: of the file.
        number: which of several, from 0.

    Raises:
        ValueError: the file has several light curves and no number is given, and the errors of `read_light_curves`.
    """
    found = read_light_curves(path)
    if number is None and len(found) > 1:
        raise ValueError(
            f"{_checks.path_text(path)} has {len(found)} light curves: give number=, from 0, or call read_light_curves"
        )
    if not 0 <= (number or 0) < len(found):
        raise ValueError(f"number must be from 0 to {len(found) - 1} for {_checks.path_text(path)}, got {number}")
    return found[number or 0]


def _check_date(text: Text, number: int, date: float) -> None:
    try:
        dates.julian_dates(date)
    except ValueError as error:
        text.fail(number, str(error))


def _damit(text: Text, at: list[int], calibrated: bool, metadata: dict[str, str]) -> LightCurve:
    """A curve of lines of eight numbers: date, intensity, Sun, Earth."""
    rows = []
    for number in at:
        words = text.lines[number - 1].split()
        if len(words) != 8:
            text.fail(number, f"a point needs 8 numbers (JD, intensity, Sun, Earth), got {len(words)}")
        row = text.numbers(number, words, "a point")
        _check_date(text, number, row[0])
        if not row[1] > 0 or not any(row[2:5]) or not any(row[5:8]):
            text.fail(number, f"the intensity must be positive, and no vector 0, got {row[1:]}")
        rows.append(row)
    x = np.array(rows)
    return LightCurve(x[:, 0], "", True, x[:, 1], False, None, calibrated, x[:, 2:5], x[:, 5:8], metadata)


def _from_plain(text: Text) -> list[LightCurve]:
    """The number of curves, then for each its number of points, whether it is calibrated, and its points."""
    at = [number for number, line in enumerate(text.lines, 1) if line.strip()]
    found: list[LightCurve] = []
    count, at = _integers(
        text, at, 1, "a file of light curves begins with their number (DAMIT), or STARTMETADATA (ALCDEF)"
    )
    for _ in range(count[0]):
        (size, code), at = _integers(text, at, 2, "a light curve begins with its number of points and 0 or 1")
        if code > 1 or not 0 < size <= len(at):
            where = at[0] - 1 if at else len(text.lines)
            text.fail(
                where, f"{size} points must follow, and the code be 0 (relative) or 1, got {len(at)} lines and {code}"
            )
        found.append(_damit(text, at[:size], code == 1, {}))
        at = at[size:]
    if at:
        text.fail(at[0], f"there are more lines than those of {count[0]} light curves")
    return found


def _integers(text: Text, at: list[int], count: int, what: str) -> tuple[list[int], list[int]]:
    """The integers of the first of these lines, and the other lines."""
    words = text.lines[at[0] - 1].split() if at else []
    if len(words) != count or not all(re.fullmatch(r"\d{1,9}", word) for word in words):
        got = f"got {_checks.printable(text.lines[at[0] - 1])!r}" if at else "but the file ends"
        text.fail(at[0] if at else 0, f"{what}, {got}")
    return [int(word) for word in words], at[1:]


def _from_json(text: Text) -> Iterator[LightCurve]:
    """A list of objects {"LightCurve": {"scale": 0 or 1, "points": lines of eight numbers}}."""
    try:
        found = json.loads("\n".join(text.lines))
    except (ValueError, RecursionError) as error:
        where = error.lineno if isinstance(error, json.JSONDecodeError) else 0
        text.fail(where, f"this is no JSON: {_checks.printable(str(error))}")
    for k, entry in enumerate(found if isinstance(found, list) else [found], 1):
        curve = entry.get("LightCurve", entry) if isinstance(entry, dict) else {}
        points = curve.get("points") if isinstance(curve, dict) else None
        if not isinstance(points, str) or curve.get("scale") not in (0, 1, "0", "1", False, True):
            text.fail(0, f"curve {k} needs LightCurve with points, a text, and scale, 0 or 1")
        part = Text(f"{text.name}, points of curve {k}", points.splitlines())
        at = [number for number, line in enumerate(part.lines, 1) if line.strip()]
        size = str(curve.get("points_count", len(at)))
        if not at or size != str(len(at)):
            text.fail(0, f"curve {k} must have {_checks.printable(size)} points, got {len(at)}")
        known = {key: str(x) for key, x in curve.items() if key != "points" and isinstance(x, str | int | float)}
        yield _damit(part, at, str(int(curve["scale"])) == "1", known)


def _from_alcdef(text: Text) -> Iterator[LightCurve]:
    """Blocks of KEY=VALUE from STARTMETADATA to ENDMETADATA, then DATA=JD|magnitude|error|airmass, to ENDDATA."""
    metadata: dict[str, str] = {}
    rows: list[list[float]] = []
    state, since = "ENDDATA", 1
    for number, line in enumerate(text.lines, 1):
        key, equals, value = (part.strip() for part in line.partition("="))
        key = key.upper()
        if not key or key.startswith("#"):
            continue
        if not equals:
            before = {"STARTMETADATA": ("ENDDATA",), "ENDMETADATA": ("STARTMETADATA",), "ENDDATA": ("ENDMETADATA",)}
            if state not in before.get(key, ()):
                text.fail(number, f"{_checks.printable(key)!r} must not follow {state} of line {since}")
            if key == "ENDDATA":
                yield _alcdef_curve(text, since, rows, metadata)
            if key == "STARTMETADATA":
                metadata, rows = {}, []
            state, since = key, number
        elif state == "STARTMETADATA":
            metadata[key] = value
        elif key == "DATA" and state == "ENDMETADATA":
            rows.append(_alcdef_row(text, number, line.partition("=")[2], metadata))
        else:
            text.fail(number, f"{_checks.printable(key)!r} must be between STARTMETADATA and ENDMETADATA")
    if state != "ENDDATA":
        text.fail(since, f"the file ends before the block of {state} does")


def _alcdef_row(text: Text, number: int, value: str, metadata: dict[str, str]) -> list[float]:
    """Date, magnitude and, if it is given, error."""
    name = metadata.get("DELIMITER", "").upper()
    if name not in _DELIMITERS:
        text.fail(number, f"DELIMITER must be PIPE or TAB, got {_checks.printable(name)!r}")
    words = [word.strip() for word in value.split(_DELIMITERS[name])]
    if len(words) < 2:
        text.fail(number, f"DATA needs a date and a magnitude, got {_checks.printable(value)!r}")
    row = text.numbers(number, [word for word in words[:3] if word], "DATA")
    _check_date(text, number, row[0])
    return row


def _alcdef_curve(text: Text, since: int, rows: list[list[float]], metadata: dict[str, str]) -> LightCurve:
    if not rows or len({len(row) for row in rows}) > 1:
        text.fail(since, "a curve needs lines DATA=…, all of them with an error of the magnitude, or none")
    x = np.array(rows)
    corrected = any(metadata.get(key, "NONE").upper() != "NONE" for key in ("LTCAPP", "LTCTYPE"))
    relative = metadata.get("DIFFERMAGS", "FALSE").upper() == "TRUE"
    errors = x[:, 2] if x.shape[1] > 2 else None
    return LightCurve(x[:, 0], "UTC", corrected, x[:, 1], True, errors, not relative, None, None, metadata)
