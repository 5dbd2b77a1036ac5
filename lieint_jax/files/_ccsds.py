"""Messages of the CCSDS as text, KEY = value: what ephemerides of orbits and of attitudes have in common."""

from __future__ import annotations

import dataclasses
import datetime
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lieint_jax import _checks, dates
from lieint_jax._text import Text

_VERSIONS = ("1.0", "2.0", "3.0")
_BLOCKS = ("META", "DATA", "COVARIANCE")


@dataclasses.dataclass
class Segment:
    """A segment of a message: its metadata, with their lines, and the words of its rows."""

    text: Text
    line: int
    meta: dict[str, tuple[int, str]]
    rows: list[tuple[int, list[str]]]

    def get(self, key: str, default: str | None = None) -> str:
        """A value of the metadata; without a default it must be there."""
        if key not in self.meta and default is None:
            self.text.fail(self.line, f"the metadata that begin here must have {key}")
        return self.meta.get(key, (0, default or ""))[1]

    def wrong(self, key: str, what: str) -> None:
        """Raise the ValueError that the value of a key must be something else."""
        line, value = self.meta.get(key, (self.line, ""))
        self.text.fail(line, f"{key} must be {what}, got {_checks.printable(value)!r}")


class Part(NamedTuple):
    """The rows of a segment as arrays: what it is about, the epoch of its first row, times since then, and values."""

    facts: dict[str, str]
    epoch: dates.Epoch
    times: np.ndarray
    values: np.ndarray


def read_segments(text: Text, kind: str) -> tuple[str, list[Segment]]:
    """The version and the segments of a message of this kind, "OEM" or "AEM"; blocks of covariance are skipped."""
    version, inside, segments = "", "", []
    for k, line in enumerate(text.lines, 1):
        line = line.strip()
        key, equals, value = (part.strip() for part in line.partition("="))
        if not line or line.split()[0] == "COMMENT":
            continue
        if not version:
            version = value
            if key != f"CCSDS_{kind}_VERS" or version not in _VERSIONS:
                first = f"CCSDS_{kind}_VERS = 1.0, 2.0 or 3.0, as text and not XML"
                text.fail(k, f"the message must begin with {first}, got {_checks.printable(line)!r}")
        elif (block := line.partition("_"))[0] in _BLOCKS and block[2] in ("START", "STOP"):
            if inside != ("" if block[2] == "START" else block[0]) or not (segments or line == "META_START"):
                text.fail(k, f"{line} must not stand {f'before {inside}_STOP' if inside else 'outside of a block'}")
            inside = block[0] if block[2] == "START" else ""
            if line == "META_START":
                segments.append(Segment(text, k, {}, []))
        elif inside == "META" and equals:
            if key in segments[-1].meta:
                text.fail(k, f"{_checks.printable(key)} is given twice in one segment")
            segments[-1].meta[key] = k, value
        elif segments and inside in ("", "DATA") and not equals:
            segments[-1].rows.append((k, line.split()))
        elif inside != "COVARIANCE" and (segments or not equals):
            text.fail(k, f"a row of data or KEY = value of metadata was expected, got {_checks.printable(line)!r}")
    if inside or not segments:
        mark = f"{inside}_STOP" if inside else "META_START"
        text.fail(len(text.lines), f"the file is cut short, or no {kind}: it ends before {mark}")
    return version, segments


def rows_of(segment: Segment, columns: Sequence[int], keys: Sequence[str]) -> Part:
    """The rows of a segment, whose numbers are as many as `columns` allow, the first of which are returned.

    Args:
        segment: the segment.
        columns: counts of numbers that a row may have after its epoch.
        keys: the metadata that say what the rows are about.
    """
    text, scale = segment.text, segment.get("TIME_SYSTEM").upper()
    if scale not in dates.SCALES:
        segment.wrong("TIME_SYSTEM", f"one of {', '.join(dates.SCALES)}")
    if "REF_FRAME_EPOCH" in segment.meta:
        segment.wrong("REF_FRAME_EPOCH", "left out: axes of date are those of each moment here")
    if not segment.rows:
        text.fail(segment.line, "the segment that begins here has no rows: the file is cut short")
    moments, values = [], []
    for line, words in segment.rows:
        moments.append(moment(text, line, words[0].removesuffix("Z"), scale))
        if len(words) - 1 not in columns:
            counts = " or ".join(map(str, columns))
            text.fail(line, f"a row must be an epoch and {counts} numbers, got {len(words) - 1}")
        values.append(text.numbers(line, words[1:], "an entry")[: columns[0]])
    times = elapsed(text, [line for line, _ in segment.rows], moments)
    step = float(np.diff(times).max(initial=0.0))
    for key, end, sign in (("START_TIME", times[0], -1), ("STOP_TIME", times[-1], 1)):
        if key in segment.meta:
            line = segment.meta[key][0]
            missing = sign * (_time_of(segment, key, scale, moments[0]) - end)
            if missing > max(step, 1e-3):
                what = f"the rows miss {missing:g} s at {key}: the file may be cut short"
                warnings.warn(f"{text.name}, line {line}: {what}", stacklevel=4)
    facts = {key: segment.get(key) for key in keys} | {"TIME_SYSTEM": scale}
    kept = _useable(segment, scale, moments[0], times)
    segment.rows = segment.rows[kept]
    return Part(facts, moments[kept][0], times[kept] - times[kept][0], np.array(values)[kept])


def _useable(segment: Segment, scale: str, first: dates.Epoch, times: np.ndarray) -> slice:
    """The rows that span the useable times of a segment: others are there for interpolation only."""
    start, stop = times[0], times[-1]
    if "USEABLE_START_TIME" in segment.meta:
        start = _time_of(segment, "USEABLE_START_TIME", scale, first)
    if "USEABLE_STOP_TIME" in segment.meta:
        stop = _time_of(segment, "USEABLE_STOP_TIME", scale, first)
    if not max(start, times[0]) <= min(stop, times[-1]):
        key = "USEABLE_STOP_TIME" if "USEABLE_STOP_TIME" in segment.meta else "USEABLE_START_TIME"
        segment.wrong(key, "a time of the rows, and USEABLE_START_TIME before USEABLE_STOP_TIME")
    return slice(max(int(np.searchsorted(times, start, "right")) - 1, 0), int(np.searchsorted(times, stop, "left")) + 1)


def _time_of(segment: Segment, key: str, scale: str, first: dates.Epoch) -> float:
    """The seconds from the first row to the time that a key of the metadata gives."""
    return moment(segment.text, segment.meta[key][0], segment.get(key).removesuffix("Z"), scale) - first


def moment(text: Text, line: int, word: str, scale: str | None) -> dates.Epoch:
    """The date that a word gives."""
    if word.count(":") == 2 and word.split(":")[2].startswith("60"):
        text.fail(line, f"{_checks.printable(word)} is in a leap second, which no time here counts: give dates in TAI")
    try:
        return dates.epoch(word, scale)
    except (ValueError, OverflowError) as error:
        return text.fail(line, _checks.printable(str(error), 400))


def elapsed(text: Text, lines: Sequence[int], moments: Sequence[dates.Epoch]) -> np.ndarray:
    """The seconds since the first of some moments, which must increase."""
    times = np.array([now - moments[0] for now in moments])
    return increasing(text, lines, times, [str(now) for now in moments] if (np.diff(times) <= 0).any() else [])


def increasing(text: Text, lines: Sequence[int], times: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Times of these lines, which must increase; `names` are how messages call them."""
    if (np.diff(times) <= 0).any():
        k = int(np.argmax(np.diff(times) <= 0))
        text.fail(lines[k + 1], f"times must increase, got {names[k + 1]} after {names[k]} of line {lines[k]}")
    return times


def one_part(
    segments: Sequence[Segment],
    number: int | None,
    read: Callable[[Segment], Part],
    same: Callable[[np.ndarray, np.ndarray], bool],
) -> Part:
    """A segment by its number, or all joined: each must begin with the `same` row with which the one before ends."""
    text, last = segments[0].text, len(segments) - 1
    if number is not None:
        if not 0 <= number <= last:
            text.fail(0, f"segment must be one of 0 to {last}, got {number}")
        return read(segments[number])
    parts = [read(segment) for segment in segments]
    whole = parts[0]
    pieces = [(whole.times, whole.values)]
    for k, part in enumerate(parts[1:], 1):
        since = part.epoch - whole.epoch if part.epoch.scale == whole.epoch.scale else 0.0
        if other := [key for key, value in part.facts.items() if value != whole.facts[key]]:
            why = f"differ in {other[0]}"
        elif abs(since - pieces[-1][0][-1]) > 1e-6:
            why = "leave a gap in time or overlap"
        else:
            why = (
                "" if same(pieces[-1][1][-1], part.values[0]) else "have different rows at the epoch at which they meet"
            )
        if why:
            text.fail(segments[k].line, f"segments {k - 1} and {k} of 0 to {last} {why}: choose one by segment={k}")
        if len(part.times) > 1:
            pieces.append((part.times[1:] + since, part.values[1:]))
    times, values = (np.concatenate(x) for x in zip(*pieces, strict=True))
    return whole._replace(times=times, values=values)


def write_message(path: str | Path, kind: str, version: str, meta: dict[str, str], rows: Iterable[str]) -> None:
    """Write a message of one segment, whose rows are lines."""
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    for key, value in meta.items():
        if not value or value != value.strip() or not value.isprintable():
            raise ValueError(f"{key} must be a line of text that is not empty, got {_checks.printable(value)!r}")
    head = {f"CCSDS_{kind}_VERS": version, "CREATION_DATE": now, "ORIGINATOR": "lieint_jax"}
    with Path(path).open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{key} = {value}\n" for key, value in head.items())
        file.writelines(["\nMETA_START\n", *(f"{key} = {value}\n" for key, value in meta.items()), "META_STOP\n\n"])
        file.writelines(f"{row}\n" for row in rows)


def span(epoch: dates.Epoch, times: np.ndarray) -> dict[str, str]:
    """The metadata of the times of a message."""
    return {"TIME_SYSTEM": epoch.scale, "START_TIME": (epoch + times[0]).iso(), "STOP_TIME": (epoch + times[-1]).iso()}


def row(epoch: dates.Epoch, time: float, values: Iterable[float]) -> str:
    """A line of data: all digits of its numbers, times to a nanosecond."""
    return " ".join([(epoch + time).iso(), *(f"{value:.16e}" for value in values)])
