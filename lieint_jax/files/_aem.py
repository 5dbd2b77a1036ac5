"""Attitude ephemeris messages (AEM) of the CCSDS.

The quaternion of a message from frame A to frame B, cos φ/2 and e sin φ/2, rotates the axes of A to those of B by φ
about e, so that v ↦ q v q* maps components in B to components in A. If B is the body, this is the package's attitude.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks, dates
from lieint_jax._checks import PRINTED
from lieint_jax._text import read_text
from lieint_jax.files import _ccsds
from lieint_jax.files._signs import join_signs
from lieint_jax.runs import Run

_BODY = re.compile(
    r"(ACC|ACTUATOR|AST|CSS|DSS|ESA|GYRO|IMU|INSTRUMENT|MTA|RW|SA|SC_BODY|SENSOR|STARTRACKER|TAM)(_\w+)?"
)
_COLUMNS = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7, "QUATERNION/ANGVEL": 7, "EULER_ANGLE": 3}
_COLUMNS |= {f"EULER_ANGLE/{rates}": 6 for rates in ("RATE", "DERIVATIVE", "ANGVEL")}


class Attitudes(NamedTuple):
    """Attitudes that a file gives.

    Attributes:
        epoch: the date of t = 0, that of the first row.
        times: in seconds since then, (n,).
        attitudes: unit quaternions (w, x, y, z) from the axes of the body, `frame_b`, to those of space, `frame_a`,
            (n, 4), each with the sign that is nearer to the one before.
        frame_a: the axes of space, as the file calls them.
        frame_b: the axes of the body.
        object: the name of the body.
        rates: the angular velocity in the axes of the body, rad/s, (n, 3), or None.
    """

    epoch: dates.Epoch
    times: np.ndarray
    attitudes: np.ndarray
    frame_a: str
    frame_b: str
    object: str
    rates: np.ndarray | None


def read_aem(path: str | Path, *, segment: int | None = None) -> Attitudes:
    """The attitudes of an attitude ephemeris message (CCSDS AEM, as text), as unit quaternions from body to space.

    Of its two frames, that of a spacecraft's body or instrument is the body; if neither or both are, frame B. Segments
    are joined as in `read_oem`. Rates are read from angular velocities and from derivatives of quaternions; those of
    Euler angles are ignored. Quaternions may deviate from norm 1 by 1e-4 and are normalized.

    Args:
        path: of the file, version 1.0 or 2.0; packed if its name ends in .gz.
        segment: the number of the segment, from 0, where they cannot be joined.

    Raises:
        ValueError: not such a message, cut short, of a spinning satellite (SPIN), rows that do not increase in time,
            quaternions that are not of norm 1, or segments that cannot be joined.

    Warns:
        UserWarning: the axes of space rotate, such as ITRF-93.

    Source: CCSDS 504.0-B-1, Attitude Data Messages, 2008, and 504.0-B-2, 2024, section 4.
    """
    text = read_text(path)
    version, segments = _ccsds.read_segments(text, "AEM")
    part = _ccsds.one_part(segments, segment, lambda found: _attitudes(found, version), _same)
    space, body, name = (part.facts[key] for key in ("SPACE", "BODY", "OBJECT_NAME"))
    if _checks.rotates(space):
        axes = f"the axes {_checks.printable(space)} rotate, and attitudes and rates are with respect to them"
        warnings.warn(f"{text.name}: {axes}; the space of a run is inertial", stacklevel=2)
    q, rates = np.split(part.values, [4], axis=1)
    return Attitudes(part.epoch, part.times, join_signs(q), space, body, name, rates if rates.shape[1] else None)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two attitudes agree; q and −q are one."""
    return bool(abs(a[:4] @ b[:4]) > 1 - 1e-9)


def _attitudes(segment: _ccsds.Segment, version: str) -> _ccsds.Part:
    """The attitudes (n, 4) of a segment from body to space, and the rates (n, 3) where there are any."""
    kind = segment.get("ATTITUDE_TYPE").upper().replace(" ", "_")
    if kind not in _COLUMNS:
        segment.wrong("ATTITUDE_TYPE", f"one of {', '.join(_COLUMNS)}")
    part = _ccsds.rows_of(segment, (_COLUMNS[kind],), ("REF_FRAME_A", "REF_FRAME_B", "OBJECT_NAME"))
    a, b = part.facts["REF_FRAME_A"], part.facts["REF_FRAME_B"]
    old = version == "1.0"
    direction = segment.get("ATTITUDE_DIR", *([] if old else ["A2B"])).upper()
    if direction not in ("A2B", "B2A"):
        segment.wrong("ATTITUDE_DIR", "A2B or B2A")
    x, rest = np.split(part.values, [3 if kind.startswith("EULER") else 4], axis=1)
    derivative = None
    if kind.startswith("EULER"):
        q = _from_angles(segment, np.radians(x))
    else:
        order = segment.get("QUATERNION_TYPE", *([] if old else ["LAST"])).upper()
        if order not in ("FIRST", "LAST"):
            segment.wrong("QUATERNION_TYPE", "FIRST or LAST")
        shift = 0 if order == "FIRST" else 1
        q, derivative = np.roll(x, shift, axis=1), np.roll(rest, shift, axis=1)
        size = np.linalg.norm(q, axis=1)
        if (wrong := abs(size - 1) > PRINTED).any():
            k = int(np.argmax(wrong))
            segment.text.fail(segment.rows[k][0], f"a quaternion must have norm 1 up to {PRINTED}, got {size[k]:.7g}")
        size = np.where(abs(size - 1) < 1e-14, 1, size)  # what was written is read again, bit for bit
        q, derivative = q / size[:, None], derivative / size[:, None]
    swapped = bool(_BODY.fullmatch(a.upper())) and not _BODY.fullmatch(b.upper())  # A is the body
    inverse = swapped == (direction == "A2B")
    q = _conjugate(q) if inverse else q
    rates = np.zeros((len(q), 0))
    if kind.endswith("/DERIVATIVE") and derivative is not None:
        rates = 2 * _multiply(_conjugate(q), _conjugate(derivative) if inverse else derivative)[:, 1:]
    elif kind.endswith("/ANGVEL"):
        rates = _rates(segment, q, np.radians(rest), swapped, a, b)
    space, body = (b, a) if swapped else (a, b)
    facts = part.facts | {"SPACE": space, "BODY": body, "ATTITUDE_TYPE": kind}
    return part._replace(facts=facts, values=np.hstack([q, rates]))


def _from_angles(segment: _ccsds.Segment, angles: np.ndarray) -> np.ndarray:
    """The quaternions of Euler angles (n, 3) about axes that rotate, in the order of the sequence."""
    word = segment.get("EULER_ROT_SEQ").upper()
    sequence = word.translate(str.maketrans("XYZ", "123"))
    if not re.fullmatch("[123]{3}", sequence) or sequence[0] == sequence[1] or sequence[1] == sequence[2]:
        segment.wrong("EULER_ROT_SEQ", "three axes, no two equal ones in succession, such as 321 or ZYX")
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(angles), 1))
    for axis, angle in zip(sequence, angles.T / 2, strict=True):
        turn = np.cos(angle)[:, None] * [1.0, 0.0, 0.0, 0.0] + np.sin(angle)[:, None] * np.eye(4)[int(axis)]
        q = _multiply(q, turn)
    return q


def _rates(segment: _ccsds.Segment, q: np.ndarray, rates: np.ndarray, swapped: bool, a: str, b: str) -> np.ndarray:
    """The angular velocity of the body in its axes, from that of frame B with respect to frame A."""
    frame = segment.get("ANGVEL_FRAME").upper()
    if frame not in (a.upper(), b.upper(), "REF_FRAME_A", "REF_FRAME_B"):
        segment.wrong("ANGVEL_FRAME", f"{a} or {b}")
    in_a = frame in (a.upper(), "REF_FRAME_A")
    if in_a != swapped:  # in the axes of space
        pure = np.hstack([np.zeros((len(q), 1)), rates])
        rates = _multiply(_multiply(_conjugate(q), pure), q)[:, 1:]
    return -rates if swapped else rates


def _conjugate(q: np.ndarray) -> np.ndarray:
    return q * [1, -1, -1, -1]


def _multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The products of quaternions, (n, 4)."""
    a, u, b, v = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    return np.hstack([a * b - np.sum(u * v, axis=1, keepdims=True), a * v + b * u + np.cross(u, v)])


def write_aem(
    path: str | Path,
    run: Run | Attitudes | tuple[ArrayLike, ArrayLike],
    *,
    epoch: str | dates.Epoch | None = None,
    frame_a: str | None = None,
    frame_b: str | None = None,
    object: str | None = None,  # noqa: A002
    body: int | None = None,
    unit_time: float = 1.0,
) -> None:
    """Write attitudes as an attitude ephemeris message (CCSDS AEM 1.0): quaternions from frame A to frame B, QC last.

    Args:
        path: of the file.
        run: a run of a body whose states have quaternions, `Attitudes`, or (times, attitudes): (n,) and unit
            quaternions (w, x, y, z) from body to space, (n, 4).
        epoch: the date of t = 0, such as "2024-03-01T12:00:00 TDB".
        frame_a: the axes of space, by default "ICRF".
        frame_b: the axes of the body, by default "SC_BODY_1".
        object: the name of the body.
        body: the number of the body, from 0, in a run of several.
        unit_time: the unit of time in s.

    Raises:
        ValueError: no epoch or object, states without quaternions, quaternions that are not of norm 1.
    """
    known: Any = run._asdict() if isinstance(run, Attitudes) else {"epoch": run.epoch} if isinstance(run, Run) else {}
    start, name = (known.get(key) if x is None else x for key, x in (("epoch", epoch), ("object", object)))
    if start is None or name is None:
        raise ValueError("give epoch=, the date of t = 0, and object=, the name of the body")
    t, q = (np.asarray(x, float) for x in _times_and_attitudes(run, body))
    if t.ndim != 1 or q.shape != (len(t), 4) or not len(t) or not (np.diff(t) > 0).all():
        raise ValueError(f"times must increase, (n,), and attitudes be (n, 4), got {t.shape} and {q.shape}")
    if not (abs(np.linalg.norm(q, axis=1) - 1) <= PRINTED).all():
        raise ValueError(f"attitudes must be unit quaternions (w, x, y, z), of norm 1 up to {PRINTED}")
    start, t = dates.epoch(start), t * unit_time
    meta = {
        "OBJECT_NAME": name,
        "OBJECT_ID": name,
        "REF_FRAME_A": frame_a or known.get("frame_a", "ICRF"),
        "REF_FRAME_B": frame_b or known.get("frame_b", "SC_BODY_1"),
        "ATTITUDE_DIR": "A2B",
        **_ccsds.span(start, t),
        "ATTITUDE_TYPE": "QUATERNION",
        "QUATERNION_TYPE": "LAST",
    }
    rows = (_ccsds.row(start, now, (*x[1:], x[0])) for now, x in zip(t.tolist(), q.tolist(), strict=True))
    _ccsds.write_message(path, "AEM", "1.0", meta, ["DATA_START", *rows, "DATA_STOP"])


def _times_and_attitudes(
    run: Run | Attitudes | tuple[ArrayLike, ArrayLike], body: int | None
) -> tuple[ArrayLike, ArrayLike]:
    if isinstance(run, Attitudes):
        return run.times, run.attitudes
    if not isinstance(run, Run):
        times, attitudes = run
        _checks.all_plain(times=times, attitudes=attitudes)
        return times, attitudes
    if run.members is not None:
        raise ValueError("a message is of one body: give one member, run.member(k)")
    q = np.asarray(run.state.q)
    if q.ndim == 3 and q.shape[2] == 7:
        if not isinstance(body, int) or not 0 <= body < q.shape[1]:
            raise ValueError(f"body must be the number of a body, 0 to {q.shape[1] - 1}, got {body}")
        return run.t, q[:, body, 3:]
    if q.ndim != 2 or q.shape[1] != 4:
        raise ValueError(f"the states must have attitudes as quaternions, got {run.system!r}: give (times, attitudes)")
    return run.t, q
