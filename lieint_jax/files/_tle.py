"""Two-line elements (TLE) and orbit mean elements messages (OMM): mean elements of SGP4."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import string
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lieint_jax import _checks, dates, orbits
from lieint_jax._text import Text, decode, read_text
from lieint_jax.files import _ccsds
from lieint_jax.files._orbit_table import OrbitTable, orbit_table

_DAY, _STEP, _MOST = 86400.0, 60.0, 10**7  # s; of a table, whose error is then 0.4 m near the Earth; entries of a table
_DEEP = 225.0  # minutes: above, Moon and Sun are part of the theory
_ALPHA = string.digits + "ABCDEFGHJKLMNPQRSTUVWXYZ"  # first digits of catalog numbers from 100 000, without I and O
_SMALL = re.compile(r"([+-]?)(\d{5})([+-]\d)")
_FIXED = {"CENTER_NAME": ("EARTH",), "REF_FRAME": ("TEME",), "TIME_SYSTEM": ("UTC",)}
_FIXED |= {"MEAN_ELEMENT_THEORY": ("SGP4", "SGP/SGP4"), "EPHEMERIS_TYPE": ("0", "2")}
_FIXED |= {"GM": ("398600.8",)}  # km³/s², WGS 72, with which elements of SGP4 are made
_OTHER = ("REF_FRAME_EPOCH", "BTERM", "AGOM")  # keys of other theories and axes, SGP4-XP among them
_UNITS = {"INCLINATION": "deg", "RA_OF_ASC_NODE": "deg", "ARG_OF_PERICENTER": "deg", "MEAN_ANOMALY": "deg"}
_UNITS |= {"MEAN_MOTION": "rev/day", "MEAN_MOTION_DOT": "rev/day**2", "MEAN_MOTION_DDOT": "rev/day**3"}
_UNITS |= {"ECCENTRICITY": "", "BSTAR": "1/ER", "GM": "km**3/s**2"}
_KEYS = (
    "MEAN_MOTION ECCENTRICITY INCLINATION RA_OF_ASC_NODE ARG_OF_PERICENTER MEAN_ANOMALY BSTAR MEAN_MOTION_DOT "
    "MEAN_MOTION_DDOT"
)  # of `Elements`


class Elements(NamedTuple):
    """The elements as a TLE prints them.

    Attributes:
        mean_motion: in revolutions per day; it contains the secular drift of the mean anomaly.
        eccentricity: without a unit.
        inclination, node, periapsis, mean_anomaly: in degrees.
        bstar: the drag term, per Earth radius.
        mean_motion_dot, mean_motion_ddot: ṅ/2 and n̈/6, per day² and day³; SGP4 does not use them.
    """

    mean_motion: float
    eccentricity: float
    inclination: float
    node: float
    periapsis: float
    mean_anomaly: float
    bstar: float = 0.0
    mean_motion_dot: float = 0.0
    mean_motion_ddot: float = 0.0


@dataclasses.dataclass(frozen=True)
class MeanElements:
    """A satellite of the Earth by its mean elements; see `read_tle` and `read_omm`.

    Attributes:
        epoch: the date of the elements (UTC), the zero of time of its orbits.
        name: the name of the satellite, or its catalog number.
        catalog_number: the number of the catalog, 0 if it has none.
        elements: see `Elements`.
    """

    epoch: dates.Epoch
    name: str
    catalog_number: int
    elements: Elements

    def orbit(self, span: float | tuple[float, float] = 2 * _DAY) -> OrbitTable:
        """The orbit of SGP4, every 60 s, in the axes TEME, in km and s; needs the package `sgp4`.

        Args:
            span: the length from the epoch in s, or (from, to).

        Raises:
            ValueError: the span is empty or of more than 10⁷ entries, or SGP4 fails: the satellite has decayed.
        """
        first, last = span if isinstance(span, tuple) else (0.0, span)
        if not (math.isfinite(first) and math.isfinite(last) and 0 < last - first <= _MOST * _STEP):
            raise ValueError(f"span must be a length or (from, to) in s, up to {_MOST * _STEP:.0e} s, got {span}")
        t = np.linspace(first, last, math.ceil((last - first) / _STEP) + 1)
        text = Text(_checks.printable(self.name), [])
        return orbit_table(text, self.epoch, t, self._sgp4(t), ("TEME", "EARTH", self.name))

    def _sgp4(self, t: np.ndarray) -> np.ndarray:
        """Positions and velocities by the package sgp4, (n, 6)."""
        try:
            from sgp4.api import SGP4_ERRORS, WGS72, Satrec
        except ImportError as error:
            raise ImportError("the orbit of SGP4 needs the package sgp4: pip install 'lieint_jax[files]'") from error
        found, satellite = self.elements, Satrec()
        e, i, node, periapsis, M = found.eccentricity, *(math.radians(x) for x in found[2:6])
        drag = (found.bstar, found.mean_motion_dot / 1440**2, found.mean_motion_ddot / 1440**3)
        since = (self.epoch - dates.epoch("1949-12-31")) / _DAY
        rate = found.mean_motion * 2 * math.pi / 1440
        satellite.sgp4init(WGS72, "i", self.catalog_number % 10**5, since, *drag, e, periapsis, i, M, rate, node)
        failed, r, v = satellite.sgp4_array(np.full(len(t), satellite.jdsatepoch), satellite.jdsatepochF + t / _DAY)
        if failed.any():
            k = int(np.argmax(failed != 0))
            name, why = _checks.printable(self.name), SGP4_ERRORS[int(failed[k])]
            raise ValueError(f"SGP4 fails for {name} at {t[k]:g} s from the epoch: {why}")
        return np.hstack([r, v])

    def secular_j2(self) -> orbits.SecularJ2:
        """The ellipse with the secular rates of J₂, without drag, in km and s with t = 0 at the epoch, in TEME.

        The drift that the mean motion contains is taken out: n = n₀ (1 + D(a)), see `orbits.secular_j2`. Near the Earth
        it stays within 20 km of SGP4 for a day.

        Raises:
            ValueError: a period above 225 minutes, where Moon and Sun matter, or a periapsis below the ground.
        """
        found = self.elements
        period = 1440 / found.mean_motion
        if period > _DEEP:
            what = f"{_checks.printable(self.name)} has a period of {period:.0f} minutes"
            raise ValueError(f"{what}; above {_DEEP:.0f}, Moon and Sun move the orbit as much as J2: use .orbit(span)")
        e, n = found.eccentricity, 2 * math.pi / (period * 60)
        i, node, periapsis, M = (math.radians(x) for x in found[2:6])
        factor = 0.75 * orbits.EARTH_J2 * orbits.EARTH_RADIUS**2 * (1 - e * e) ** -1.5 * (3 * math.cos(i) ** 2 - 1)
        a = (orbits.EARTH_GM / n**2) ** (1 / 3)
        for _ in range(5):  # D is of order 1e-3, so that each sweep gains three digits
            a = (orbits.EARTH_GM * (1 + factor / a**2) ** 2 / n**2) ** (1 / 3)
        time = -math.remainder(M, 2 * math.pi) / n
        rates = orbits.secular_j2(orbits.EARTH_GM, a, e, i).rates
        node, periapsis = (x + float(rate) * time for x, rate in zip((node, periapsis), rates[:2], strict=True))
        found_orbit = orbits.secular_j2(orbits.EARTH_GM, a, e, i, node=node, periapsis=periapsis, periapsis_time=time)
        return dataclasses.replace(found_orbit, frame="TEME")


def read_tle(lines: str | Path | Sequence[str], *, satellite: str | int | None = None) -> MeanElements:
    """The mean elements of a satellite from its two lines (TLE), with or without a line of its name before them.

    Args:
        lines: the lines, as a list or as one text, or the path of a file.
        satellite: the name or the catalog number, where there are several.

    Returns:
        `MeanElements`: `.orbit(span)` is the orbit of SGP4, `.secular_j2()` an ellipse with secular rates.

    Raises:
        ValueError: no such lines, a wrong checksum, elements of another theory than SGP4, such as SGP4-XP (ephemeris
            type 4), or several satellites of which none was chosen.

    Source: Vallado et al. 2006, AIAA 2006-6753; alpha-5 catalog numbers: space-track.org.
    """
    if isinstance(lines, Path) or (isinstance(lines, str) and lines and not re.search(r"[\r\n]", lines)):
        text = read_text(lines)
    else:
        joined = lines if isinstance(lines, str) else "\n".join(map(str, lines))
        text = decode("the TLE", joined.encode("utf-8", "replace"))
    found, name, first = [], "", None
    for k, line in enumerate(map(str.rstrip, text.lines), 1):
        if not line:
            continue
        if first is not None:
            found.append(_elements(text, k, first, line, name))
            name, first = "", None
        elif line.startswith("1 ") and len(line) > 24:
            first = line
        else:
            name = line.removeprefix("0 ").strip()
    if first is not None:
        text.fail(len(text.lines), "the second line of the elements is missing: the file is cut short")
    if not found:
        lines = "a line of 69 characters that begins with '1 ', then one with '2 '"
        text.fail(0, f"elements of one satellite are needed, got 0: give {lines}")
    return _chosen(text, found, satellite)


def _elements(text: Text, k: int, first: str, second: str, name: str) -> MeanElements:
    """The elements of two lines, the second of which is line k."""
    for number, line, at in (("1", first, k - 1), ("2", second, k)):
        if not line.startswith(f"{number} ") or len(line) != 69:
            text.fail(at, f"line {number} of a TLE must begin with {number} and have 69 characters, it has {len(line)}")
        total = sum(int(c) if c in string.digits else c == "-" for c in line[:68]) % 10
        if line[68] != str(total):
            text.fail(at, f"the checksum must be {total}, got {_checks.printable(line[68])!r}: a character is wrong")
    if first[2:7] != second[2:7]:
        text.fail(k, f"both lines must be of one satellite, got {_checks.printable(f'{first[2:7]} and {second[2:7]}')}")
    catalog = first[2:7].strip()
    if not re.fullmatch(r"[0-9A-HJ-NP-Z]?\d{1,4}", catalog):
        text.fail(k - 1, f"the catalog number must be 5 digits, or a letter but I and O and 4, got {catalog!r}")
    number = int(catalog) if catalog.isdigit() else _ALPHA.index(catalog[0]) * 10**4 + int(catalog[1:])
    year, day = first[18:20].replace(" ", "0"), first[20:32].strip().replace(" ", "0")
    if not re.fullmatch(r"\d\d", year) or not re.fullmatch(r"\d{1,3}(\.\d*)?", day):
        text.fail(k - 1, f"the epoch must be two digits of the year and a day, got {_checks.printable(first[18:32])!r}")
    midnight = _ccsds.moment(text, k - 1, f"{1900 + int(year) + 100 * (int(year) < 57)}-{int(float(day)):03d}", "UTC")
    start = dataclasses.replace(midnight, second=Fraction(day) % 1 * 86400)
    whole = second[26:33].replace(" ", "0")
    if not whole.isdigit():
        text.fail(k, f"the eccentricity must be seven digits, got {_checks.printable(whole)!r}")
    if first[62] not in "02 ":  # 4 is SGP4-XP, 1, 3, 5 and 6 are older theories
        text.fail(k - 1, f"the ephemeris type (column 63) must be 0, SGP4, got {_checks.printable(first[62])!r}")
    words = {"inclination": second[8:16], "node": second[17:25], "periapsis": second[34:42]}
    words |= {"mean_anomaly": second[43:51], "mean_motion": second[52:63]}
    values = {key: text.number(k, word.strip(), f"the {key.replace('_', ' ')}") for key, word in words.items()}
    values |= {"eccentricity": float(f"0.{whole}"), "mean_motion_dot": text.number(k - 1, first[33:43].strip(), "ṅ/2")}
    for key, word in (("mean_motion_ddot", first[44:52]), ("bstar", first[53:61])):
        parts = _SMALL.fullmatch(word.strip().replace(" ", "0"))
        if parts is None:
            text.fail(k - 1, f"{key} must be as in 12345-3 for 0.12345e-3, got {_checks.printable(word)!r}")
        values[key] = float(f"{parts[1]}0.{parts[2]}e{parts[3]}")
    return _checked(text, k, MeanElements(start, name or str(number), number, Elements(**values)))


def _checked(text: Text, line: int, found: MeanElements) -> MeanElements:
    """The elements, if they are those of an ellipse."""
    x = found.elements
    if not (0 < x.mean_motion < 20 and 0 <= x.eccentricity < 1 and 0 <= x.inclination <= 180):
        what = f"{x.mean_motion:g} revolutions a day, e = {x.eccentricity:g}, {x.inclination:g}°"
        text.fail(line, f"the mean motion must be 0 to 20, the eccentricity 0 to 1, the inclination 0 to 180°: {what}")
    return found


def _chosen(text: Text, found: Sequence[MeanElements], satellite: str | int | None) -> MeanElements:
    """The one satellite of this name or number, or the only one."""
    wanted = [x for x in found if satellite is None or str(satellite) in (x.name, str(x.catalog_number))]
    epochs = sorted({str(x.epoch) for x in wanted})
    if len({x.catalog_number or x.name for x in wanted}) == 1 < len(epochs):
        name, span = _checks.printable(wanted[0].name), f"from {epochs[0]} to {epochs[-1]}"
        text.fail(0, f"there are elements of {name} for {len(epochs)} epochs, {span}: give those of one epoch only")
    if len(wanted) != 1:
        names = _checks.printable(", ".join(f"{x.name} ({x.catalog_number})" for x in (wanted or found)[:8]))
        text.fail(0, f"elements of one satellite are needed, got {len(wanted)}: give satellite=, one of: {names}")
    return wanted[0]


def read_omm(path: str | Path, *, satellite: str | int | None = None) -> MeanElements:
    """The mean elements of a satellite from an orbit mean elements message (CCSDS OMM) of SGP4: text, XML or JSON.

    Args:
        path: of the file, such as CelesTrak's GP data in the formats KVN, XML and JSON.
        satellite: the name or the catalog number, where there are several.

    Raises:
        ValueError: no such message, another theory than SGP4, such as SGP4-XP, other axes, units or constants than its
            own, or several satellites of which none was chosen.

    Source: CCSDS 502.0-B-3, Orbit Data Messages, 2023, section 4.
    """
    text = read_text(path)
    whole = "\n".join(text.lines).strip()
    form = {"[": _of_json, "{": _of_json, "<": _of_xml}.get(whole[:1], _of_lines)
    messages = form(text, whole)
    if not messages:
        text.fail(0, "there is no orbit mean elements message (OMM) as text, XML or JSON")
    return _chosen(text, [_of_message(text, message) for message in messages], satellite)


def _of_message(text: Text, message: Mapping[str, tuple[int, str]]) -> MeanElements:
    """The elements of the keys of a message, each with its line."""
    message = {key: given for key, given in message.items() if given[1]}
    for key in _OTHER:
        if key in message:
            text.fail(message[key][0], f"{key} must be left out: it is no element of SGP4 in TEME")
    message = {key: (line, _without_unit(text, line, key, value)) for key, (line, value) in message.items()}
    for key, allowed in _FIXED.items():
        line, value = message.get(key, (0, allowed[0]))
        if value.upper() not in allowed:
            text.fail(line, f"{key} must be {allowed[0]}, as SGP4 needs, got {_checks.printable(value)!r}")
    values = {}
    for name, key in zip(Elements._fields, _KEYS.split(), strict=True):
        if key in message:
            values[name] = text.number(*message[key], key)
        elif "DOT" not in key:
            text.fail(0, f"the message must have {key}: it is no message of SGP4, or is cut short")
    if "EPOCH" not in message:
        text.fail(0, "the message must have EPOCH")
    number = int(text.number(*message["NORAD_CAT_ID"], "NORAD_CAT_ID")) if "NORAD_CAT_ID" in message else 0
    name = message.get("OBJECT_NAME", (0, str(number)))[1]
    line, word = message["EPOCH"]
    return _checked(text, line, MeanElements(_ccsds.moment(text, line, word, "UTC"), name, number, Elements(**values)))


def _without_unit(text: Text, line: int, key: str, value: str) -> str:
    """The value of a key without its unit in brackets, which must be that of the standard."""
    found = re.fullmatch(r"(.*?)\s*\[(.*)\]\s*", value) if key in _UNITS else None
    if found and found[2].strip().lower() != _UNITS[key].lower():
        text.fail(line, f"the unit of {key} must be {_UNITS[key]}, got {_checks.printable(found[2])!r}")
    return found[1].strip() if found else value


def _of_lines(text: Text, whole: str) -> list[dict[str, tuple[int, str]]]:
    messages: list[dict[str, tuple[int, str]]] = []
    for k, line in enumerate(text.lines, 1):
        key, equals, value = (part.strip() for part in line.partition("="))
        if key == "CCSDS_OMM_VERS" or (key == "OBJECT_NAME" and not messages):
            messages.append({})
        if equals and messages and not key.startswith("COMMENT"):
            if key in messages[-1] and key in (*_FIXED, *_UNITS, "EPOCH"):
                text.fail(k, f"{key} is given twice in one message")
            messages[-1][key] = k, value
    return messages


def _of_json(text: Text, whole: str) -> list[dict[str, tuple[int, str]]]:
    try:
        found = json.loads(whole, parse_int=str, parse_float=str, parse_constant=str)
    except (json.JSONDecodeError, RecursionError) as error:
        at = error.lineno if isinstance(error, json.JSONDecodeError) else 0
        text.fail(at, f"the JSON cannot be read, or is cut short: {error}")
    found = found if isinstance(found, list) else [found]
    if not all(isinstance(message, dict) for message in found):
        text.fail(0, "the JSON must be a list of objects, each with the keys of an OMM")
    return [{key: (0, str(value)) for key, value in message.items() if value is not None} for message in found]


def _of_xml(text: Text, whole: str) -> list[dict[str, tuple[int, str]]]:
    if "<!" in whole.replace("<!--", ""):
        text.fail(0, "the XML must have no DOCTYPE, no entities and no CDATA")
    try:
        root = ElementTree.fromstring(whole)
    except (ElementTree.ParseError, RecursionError) as error:
        at = error.position[0] if isinstance(error, ElementTree.ParseError) else 0
        text.fail(at, f"the XML cannot be read, or is cut short: {error}")
    for x in root.iter():
        x.tag = x.tag.rpartition("}")[2]  # without its namespace
    found = root.iter("omm")
    return [{x.tag: (0, _with_unit(x)) for x in message.iter() if not len(x)} for message in found]


def _with_unit(element: ElementTree.Element) -> str:
    """The text of an element of XML, and its unit in brackets as in a message of lines."""
    text, unit = (element.text or "").strip(), element.get("units")
    return text if unit is None else f"{text} [{unit}]"
