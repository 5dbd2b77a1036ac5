"""Work and precision: cost against error of every scheme and peer, at several step sizes.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from lib import measure, peers
from lib.contest import Contestant, race
from lib.measure import BATCH, INERTIA, WATCHED, Problem

import lieint_jax as li
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

_TOLERANCES = tuple(10.0**-k for k in range(4, 14))  # of adaptive peers
_LOOSEST = 1e-3  # the largest tolerance × time: Runge–Kutta lets |q| grow, and at 1e-1 the motion blows up


class Sizes(NamedTuple):
    """The extent of the measurements.

    Attributes:
        ends: times of comparison, multiples of 10.
        rounds: timed calls, for each end.
        stride: every `stride`-th point of a curve is measured, for each end.
        longest: the longest expected duration of a call, s; judged by its duration to the previous end.
    """

    ends: tuple[float, ...] = (10.0, 1000.0)
    rounds: tuple[int, ...] = (5, 1)
    stride: tuple[int, ...] = (1, 2)
    longest: float = 2.0


QUICK = Sizes((10.0, 100.0), (1, 1), (5, 10), 0.3)


class Curve(NamedTuple):
    """A scheme or a peer, and its step sizes or tolerances.

    Attributes:
        name: for the tables.
        kind: "order 2", "composition", "preprocessed", "exact" or "peer".
        make: step size ↦ contestant; for adaptive peers, (time, tolerance) ↦ contestant.
        counts: numbers of steps in a time of 10; for "exact", in the whole time.
        tolerances: those of adaptive peers, which have no counts.
        bodies: the number of bodies for timing.
    """

    name: str
    kind: str
    make: Callable[..., Contestant]
    counts: Sequence[int] = ()
    tolerances: Sequence[float] = ()
    bodies: int = BATCH


class Point(NamedTuple):
    """A point of a curve: its contestant, number of steps, and step size or tolerance, `setting`."""

    curve: Curve
    contestant: Contestant
    steps: int
    setting: float


def curves() -> list[Curve]:
    """The curves of all our schemes for the free body, then of the peers."""
    body, make = measure.body(), li.schemes
    steps: list[tuple[str, str, li.Step, Sequence[int]]] = [
        (f"κ {kappa.name}", "order 2", make.so3_midpoint(body, kappa), growing(25, 6, 2))
        for kappa in (kappa_symplectic, kappa_cayley, kappa_exponential)
    ]
    base = make.so3_midpoint(body)
    for order, points in ((4, 9), (6, 8), (8, 7), (10, 7)):
        name = f"compose {order}, commuting"
        steps.append((name, "composition", make.compose(base, order), growing(5, points)))
    steps += [
        ("compose 8, Kahan & Li", "composition", make.compose(base, 8, "kahan_li_8"), growing(7, 7)),
        (
            "compose 4 of κ Cayley, Suzuki",
            "composition",
            make.compose(make.so3_midpoint(body, kappa_cayley), 4),
            growing(7, 8),
        ),
        ("preprocessed 4", "preprocessed", make.preprocessed(body, 4), growing(12, 11)),
        ("preprocessed 6", "preprocessed", make.preprocessed(body, 6), growing(12, 12)),
        ("calibrated", "exact", make.calibrated(body), (10, 20, 40)),
        ("exact", "exact", make.exact(body), (1, 10, 100)),
    ]
    scipy = Curve("scipy DOP853", "peer", partial(peers.dop853, INERTIA), tolerances=_TOLERANCES, bodies=WATCHED)
    return [*of_ours(steps), *of_peers(13, 11, 7), scipy]


def of_ours(steps: Sequence[tuple[str, str, li.Step, Sequence[int]]]) -> list[Curve]:
    """The curves of our steps, each given by its curve's name and kind, the step, and numbers of steps."""
    return [
        Curve(name, kind, partial(measure.ours, name, step, wide=True), counts) for name, kind, step, counts in steps
    ]


def of_peers(tsit5: int, dopri8: int, mujoco: int, weight: Sequence[float] | None = None) -> list[Curve]:
    """The curves of diffrax and MuJoCo, with so many step sizes each; for tops of this weight, if one is given."""
    fives, eights = (partial(peer, INERTIA, wide=True, weight=weight) for peer in (peers.tsit5, peers.dopri8))
    rollout = partial(peers.mujoco_rk4, INERTIA, weight=weight)
    return [
        Curve("diffrax Tsit5", "peer", fives, growing(20, tsit5)),
        Curve("diffrax Tsit5, adaptive", "peer", fives, tolerances=_TOLERANCES),
        Curve("diffrax Dopri8", "peer", eights, growing(5, dopri8)),
        Curve("diffrax Dopri8, adaptive", "peer", eights, tolerances=_TOLERANCES),
        Curve("MuJoCo RK4", "peer", rollout, growing(25, mujoco, 2), bodies=WATCHED),
    ]


def growing(first: int, points: int, factor: float = 2**0.5) -> tuple[int, ...]:
    return tuple(round(first * factor**k) for k in range(points))


def everything(sizes: Sizes, problem: Problem | None = None, contest: Sequence[Curve] | None = None) -> dict[str, Any]:
    """All results, as values that JSON can hold; by default for the free body. Run it on one core."""
    notes: list[str] = []
    problem = problem or Problem(measure.body(), measure.reference)
    contest = contest or curves()
    found: list[dict[str, Any]] = []
    for end, rounds, stride in zip(sizes.ends, sizes.rounds, sizes.stride, strict=True):
        long = {key for before in found for key in _too_long(before, end, sizes.longest)}
        points = [x for curve in contest for x in _points(curve, end, stride, notes) if _key(x) not in long]
        found.append(at(end, points, rounds, problem))
    return {"machine": measure.machine(), "ends": found, "notes": notes}


def at(end: float, points: Sequence[Point], rounds: int, problem: Problem) -> dict[str, Any]:
    """Milliseconds per 1000 bodies, attitude error and energy drift of every point at t = end.

    The points are called in turn, and the best call counts. The error is that of the worst of `WATCHED` bodies, the
    drift that of the worst timed body. An error smaller than the distance of the two references is set to it.
    """
    exact, doubt = problem.reference(end)
    records: list[dict[str, Any]] = []
    for count in (BATCH, WATCHED):
        group = [x for x in points if x.curve.bodies == count]
        q, p = measure.bodies(count)
        timings = race([x.contestant for x in group], q, p, [x.steps for x in group], rounds)
        for point, timing in zip(group, timings, strict=True):
            best = min(timing.first, *timing.later)
            records.append(
                _record(point, q, p, exact, doubt, problem.system) | {"milliseconds": 1e3 * best * 1000 / count}
            )
    return {"end": end, "reference_doubt": doubt, "points": records}


def _points(curve: Curve, end: float, stride: int, notes: list[str]) -> list[Point]:
    """The points of a curve at t = end; if its package is not installed, none, and a note is appended to `notes`."""
    times = 1 if curve.name == "exact" else round(end / 10)
    try:
        if curve.tolerances:
            tight = [rtol for rtol in curve.tolerances if rtol * end < 2 * _LOOSEST]
            return [Point(curve, curve.make(dt=end, rtol=rtol), 1, rtol) for rtol in tight[::stride]]
        counts = [times * n for n in curve.counts[::stride]]
        return [Point(curve, curve.make(dt=end / n), n, end / n) for n in counts]
    except ImportError as error:
        note = f"{curve.name} left out: {error}"
        if note not in notes:
            notes.append(note)
        return []


def _key(point: Point) -> tuple[str, str]:
    return point.curve.name, f"{point.setting:.6g}"


def _too_long(before: dict[str, Any], end: float, longest: float) -> list[tuple[str, str]]:
    """The points that will take longer than `longest` to t = end."""
    factor = end / before["end"] / 1e6
    return [
        (r["curve"], f"{r['setting']:.6g}")
        for r in before["points"]
        if r["milliseconds"] * r["bodies"] * factor > longest
    ]


def _record(point: Point, q: np.ndarray, p: np.ndarray, exact: np.ndarray, doubt: float, system: Any) -> dict[str, Any]:
    contestant = point.contestant
    end = contestant.advance(contestant.load(q, p), point.steps)
    after = contestant.read(end)
    return {
        "curve": point.curve.name,
        "kind": point.curve.kind,
        "bodies": point.curve.bodies,
        "adaptive": bool(point.curve.tolerances),
        "setting": point.setting,
        "steps": point.steps,
        "error": max(measure.attitude_error(after[0][:WATCHED], exact), doubt),
        "energy_drift": measure.energy_drift(system, *(np.stack(pair) for pair in zip((q, p), after, strict=True))),
        "converged": contestant.info(end)[1] if contestant.info else None,
    }
