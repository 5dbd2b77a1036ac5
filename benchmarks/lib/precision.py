"""Work and precision: cost against error of schemes and peers, each at several step sizes or tolerances.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from lib import measure, peers, taylor
from lib.contest import Contestant
from lib.measure import BATCH, WATCHED, States

import lieint_jax as li

ORDER_2, COMPOSED, PREPROCESSED, EXACT = "order 2", "compositions", "preprocessed", "closed form"  # kinds of curves
TWO_BODY, EXTRAPOLATED = "splittings of bodies", "extrapolation"
GAUSS = CONVERGED, ROUGH = ("gauss, converged", "gauss, fixed sweeps")
PEERS = ("heyoka", "diffrax", "astrojax", "MuJoCo", "scipy")  # kinds of curves that are not ours
TOLERANCES = tuple(10.0**-k for k in range(4, 16))  # of heyoka
TIGHT = 1e-16  # heyoka's tolerance as a reference


class Sizes(NamedTuple):
    """The extent of the measurements.

    Attributes:
        bodies: the number of bodies of a batch.
        rounds: timed calls of each point.
        stride: every `stride`-th point of a curve is measured.
        curves: the most curves of a kind; a program that compiles for seconds belongs to each of ours.
        longest: the longest expected duration of a call, s, judged by the point before on the curve.
        seconds: a point that was timed for so long, and twice, is not called again.
    """

    bodies: int = BATCH
    rounds: int = 5
    stride: int = 1
    curves: int = 100
    longest: float = 3.0
    seconds: float = 1.0


QUICK = Sizes(bodies=64, rounds=1, stride=4, curves=1, longest=0.5)


class Curve(NamedTuple):
    """A scheme or a peer, and its step sizes or tolerances.

    Attributes:
        name: for the tables.
        kind: the family that it belongs to; one of `PEERS` if it is not ours.
        make: step size ↦ contestant; for adaptive peers, (time, tolerance) ↦ contestant.
        counts: numbers of steps to the end, growing.
        tolerances: those of adaptive peers, which have no counts.
        bodies: the most bodies for timing.
        rough: its steps solve no equation to round-off, and need not say that they converged.
    """

    name: str
    kind: str
    make: Callable[..., Contestant]
    counts: Sequence[int] = ()
    tolerances: Sequence[float] = ()
    bodies: int = BATCH
    rough: bool = False


class Point(NamedTuple):
    """A point of a curve: its contestant, number of steps, and step size or tolerance, `setting`."""

    curve: Curve
    contestant: Contestant
    steps: int
    setting: float


class Problem(NamedTuple):
    """What is integrated, by whom, and how errors are measured.

    Attributes:
        name: for the tables.
        error: what the error is of, with its unit.
        end: the duration.
        start: number of members ↦ their initial states.
        reference: initial states ↦ configurations at the end, the distance of those of a second reference, (B,), and
            what the two are.
        curves: the contestants.
        apart: (configurations, exact ones) ↦ errors, (B,).
        energy: (configurations, momenta), axes (times, members, …) ↦ the largest energy drift; None where energy is not
            conserved.
    """

    name: str
    error: str
    end: float
    start: Callable[[int], States]
    reference: Callable[[States], tuple[np.ndarray, np.ndarray, str]]
    curves: Sequence[Curve]
    apart: Callable[[np.ndarray, np.ndarray], np.ndarray] = measure.attitude_errors
    energy: Callable[[np.ndarray, np.ndarray], float] | None = None


def growing(first: float, points: int, factor: float = 2**0.5) -> tuple[int, ...]:
    return tuple(round(first * factor**k) for k in range(points))


def of_peers(
    inertia: Sequence[float],
    weight: Sequence[float] | None,
    unit: float,
    tolerances: Sequence[float] = tuple(10.0**-k for k in range(4, 14)),
) -> list[Curve]:
    """The curves of diffrax, MuJoCo and heyoka for free bodies, or tops; steps in proportion to `unit`."""
    fives, eights = (partial(peer, inertia, wide=True, weight=weight) for peer in (peers.tsit5, peers.dopri8))
    rollout = partial(peers.mujoco_rk4, inertia, weight=weight)
    return [
        Curve("diffrax Tsit5", "diffrax", fives, growing(2 * unit, 14)),
        Curve("diffrax Tsit5, adaptive", "diffrax", fives, (), tolerances),
        Curve("diffrax Dopri8", "diffrax", eights, growing(unit / 2, 11)),
        Curve("diffrax Dopri8, adaptive", "diffrax", eights, (), tolerances),
        Curve("MuJoCo RK4", "MuJoCo", rollout, growing(2.5 * unit, 6, 2), bodies=WATCHED),
        Curve("heyoka", "heyoka", taylor.of_bodies(inertia, weight or (0.0, 0.0, 0.0)), (), TOLERANCES),
    ]


def flowed(system: Any, states: States, end: float, num_steps: int, t0: float | None = None) -> np.ndarray:
    """Configurations at the end by `diagnostics.flow`; those of a driven system start at t0, which all share."""
    start = li.State(jnp.asarray(states[0]), jnp.asarray(states[1]), None if t0 is None else jnp.asarray(t0))
    flow = jax.vmap(li.diagnostics.flow, (None, li.State(0, 0, None), None, None))  # pyright: ignore[reportArgumentType]
    return np.asarray(jax.jit(flow, static_argnums=3)(system, start, end, num_steps).q)


def checked(
    problem: Problem, exact: np.ndarray, states: States, by: str = "`diagnostics.flow`"
) -> tuple[np.ndarray, np.ndarray, str]:
    """A reference, and its distance from heyoka at its tightest, which shares nothing with it."""
    [tight] = (curve.make(dt=problem.end, rtol=TIGHT) for curve in problem.curves if curve.kind == "heyoka")
    doubts = problem.apart(tight.read(tight.advance(tight.load(*states), 1))[0], exact)
    return exact, doubts, f"{by} and heyoka with a tolerance of {TIGHT:g}"


def measured(problem: Problem, sizes: Sizes, notes: list[str]) -> dict[str, Any]:
    """Times and errors of every curve of a problem, as values that JSON can hold. Run it on one core."""
    start = problem.start(sizes.bodies)
    exact, doubts, references = problem.reference(start)
    points: list[Point] = []
    for kind in dict.fromkeys(curve.kind for curve in problem.curves):
        for curve in [x for x in problem.curves if x.kind == kind][: sizes.curves]:
            points += points_of(curve, problem.end, sizes.stride, notes)
    return {
        "problem": problem.name,
        "error": problem.error,
        "end": problem.end,
        "bodies": sizes.bodies,
        "references": references,
        "reference_doubt": float(doubts.max()),
        "median_doubt": float(np.median(doubts)),
        "points": records(points, start, exact, doubts, sizes, notes, problem.apart, problem.energy, problem.name),
    }


def points_of(curve: Curve, end: float, stride: int, notes: list[str]) -> list[Point]:
    """Every `stride`-th point of a curve to t = end; if its package is not installed, none, and a note is appended."""
    try:
        if curve.tolerances:
            return [Point(curve, curve.make(dt=end, rtol=rtol), 1, rtol) for rtol in curve.tolerances[::stride]]
        return [Point(curve, curve.make(dt=end / n), n, end / n) for n in curve.counts[::stride]]
    except ImportError as error:
        note = f"{curve.name} left out: {error}"
        if note not in notes:
            notes.append(note)
        return []


class _Race(NamedTuple):
    """A point, its initial states in its own form, those at the end, and the seconds of each timed call."""

    point: Point
    loaded: Any
    end: Any
    seconds: list[float]

    def call(self) -> None:
        began = time.perf_counter()
        self.point.contestant.advance(self.loaded, self.point.steps)
        self.seconds.append(time.perf_counter() - began)

    def expected(self, steps: int) -> float:
        """Seconds of so many steps of the same curve."""
        return min(self.seconds) * steps / self.point.steps


def records(
    points: Sequence[Point],
    start: States,
    exact: np.ndarray,
    doubts: np.ndarray,
    sizes: Sizes,
    notes: list[str],
    apart: Callable[[np.ndarray, np.ndarray], np.ndarray] = measure.attitude_errors,
    energy: Callable[[np.ndarray, np.ndarray], float] | None = None,
    where: str = "",
) -> list[dict[str, Any]]:
    """Milliseconds per 1000 members, the best call of each point, and errors of those members that `exact` knows.

    The first call of a point compiles and is not timed. Points are then called in turn, round after round. An error
    smaller than that of the reference, `doubts`, is set to it. Points that take too long, or are refused, are left out
    with a note.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of members that did not converge: it is in the record
        races: list[_Race] = []
        for point in points:
            race = _entered(point, start, races, sizes, f"{where}{': ' if where else ''}{point.curve.name}", notes)
            races += [race] if race else []
        for done in range(1, sizes.rounds):
            for race in races:
                if len(race.seconds) <= done and (done == 1 or sum(race.seconds) < sizes.seconds):
                    race.call()
    return [_record(race, start, exact, doubts, apart, energy) for race in races]


def _entered(
    point: Point, start: States, before: Sequence[_Race], sizes: Sizes, name: str, notes: list[str]
) -> _Race | None:
    """The point's race after two calls, the second of them timed; None, with a note, if it takes no part."""
    same = [race for race in before if race.point.curve.name == point.curve.name]
    if same and same[-1].expected(point.steps) > sizes.longest:
        if len(same[-1].seconds) == 1:
            same[-1].call()  # that may have been a slow spell of the machine
        if same[-1].expected(point.steps) > sizes.longest:
            _note(notes, f"{name}, left out as longer than {sizes.longest:g} s, steps:", point.steps)
            return None
    contestant = point.contestant
    loaded = contestant.load(*(x[: point.curve.bodies] for x in start))
    try:
        race = _Race(point, loaded, contestant.advance(loaded, point.steps), [])
    except ValueError as refusal:
        _note(notes, f"{name}, refused ({str(refusal).split(' for ')[0]}), steps:", point.steps)
        return None
    race.call()
    return race


def _note(notes: list[str], beginning: str, steps: int) -> None:
    """Say it, or add the number to what was said last if that was the same."""
    if notes and notes[-1].startswith(beginning):
        notes[-1] += f", {steps}"
    else:
        notes.append(f"{beginning} {steps}")


def _record(
    race: _Race,
    start: States,
    exact: np.ndarray,
    doubts: np.ndarray,
    apart: Callable[[np.ndarray, np.ndarray], np.ndarray],
    energy: Callable[[np.ndarray, np.ndarray], float] | None,
) -> dict[str, Any]:
    curve, contestant = race.point.curve, race.point.contestant
    q, p = contestant.read(race.end)
    count = min(len(q), len(exact))
    errors = apart(q[:count], exact[:count])
    pairs = (np.stack(pair) for pair in zip((x[: len(q)] for x in start), (q, p), strict=True))
    return {
        "curve": curve.name,
        "kind": curve.kind,
        "ours": curve.kind not in PEERS,
        "bodies": len(q),
        "adaptive": bool(curve.tolerances),
        "setting": race.point.setting,
        "steps": race.point.steps,
        "milliseconds": 1e3 * min(race.seconds) * 1000 / len(q),
        "error": max(float(errors.max()), float(doubts.max())),
        "median_error": max(float(np.median(errors)), float(np.median(doubts))),
        "energy_drift": None if energy is None else energy(*pairs),
        "converged": contestant.info(race.end)[1] if contestant.info else None,
        "rough": curve.rough,
    }
