"""The problems of `work_precision.py`, and who takes part in each.

A contestant is one line: its name, family, step and numbers of steps. Ours run through `li.run`, the whole call
of which is timed. Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib import binaries, measure, peers, precision, satellites, taylor
from lib.measure import INERTIA, WATCHED, States
from lib.precision import (
    COMPOSED,
    CONVERGED,
    EXACT,
    EXTRAPOLATED,
    ORDER_2,
    PREPROCESSED,
    ROUGH,
    TOLERANCES,
    TWO_BODY,
    Curve,
    Problem,
    flowed,
    growing,
)

import lieint_jax as li
from lieint_jax.groups import so3

_LOOSE = tuple(10.0**-k for k in range(3, 13))  # tolerances of diffrax
_TOP, _WEIGHT, _SPEED, _TILT = (1.0, 2.0, 2.5), (0.5, 0.4, 1.0), 1.2, 0.3
_ASTEROID, _TUMBLING = (0.61, 0.965, 1.0), 0.23  # Apophis' ratios of inertia; rad/h
_NEAREST = 38340.0  # km from the center of the Earth, the unit of length
_FLYBY = 96.0  # hours before and after

Ours = Callable[..., Curve]  # (name, kind, step, counts) ↦ curve


def ours(name: str, kind: str, step: li.Step, counts: Sequence[int], **how: Any) -> Curve:
    """A curve of ours through `li.run`, `how` as in `measure.ours`."""
    return Curve(name, kind, partial(measure.ours, name, step, **how), counts, rough=kind == ROUGH)


# stages, or order, or (stages, sweeps), or (order, increments), and the number of steps to begin with, in units
_CONVERGED = ((8, 1.0), (6, 1.4), (4, 4.0))
_ROUGH = ((6, 14, 1.3), (7, 16, 1.4), (8, 18, 1.1), (8, 16, 1.2))
_EXTRAPOLATED = ((12, True, 1.6), (14, False, 1.05), (14, True, 1.3), (16, True, 1.2))
_COMPOSED = ((8, 2.5), (10, 1.8), (6, 4.0))


def high_order(system: Any, curve: Ours, unit: float, points: int = 6, most: int = 2) -> Iterator[Curve]:
    """Gauss and extrapolation, the `most` likely of each; Gauss of 8 stages needs some `unit` steps."""
    make = li.schemes
    for stages, first in _CONVERGED[:most]:
        counts = growing(first * unit, points, 1.25)
        yield curve(f"gauss {stages}", CONVERGED, make.gauss(system, stages), counts)
    for stages, sweeps, first in _ROUGH[:most]:
        name, counts = f"gauss {stages}, {sweeps} sweeps", growing(first * unit, points, 1.2)
        yield curve(name, ROUGH, make.gauss(system, stages, sweeps), counts)
    for order, increments, first in _EXTRAPOLATED[:most]:
        name, counts = f"extrapolate {order}{'' if increments else ', plain'}", growing(first * unit, points, 1.3)
        yield curve(name, EXTRAPOLATED, make.extrapolate(system, order, increments), counts)


def composed(base: li.Step, curve: Ours, unit: float, points: int = 6, most: int = 2) -> Iterator[Curve]:
    for order, first in _COMPOSED[:most]:
        counts = growing(first * unit, points, 1.5)
        yield curve(f"compose {order}", COMPOSED, li.schemes.compose(base, order), counts)
    if isinstance(base.system, li.systems.AbstractForcedSystem | li.systems.AbstractDrivenSystem):
        yield curve("nystrom 6", COMPOSED, li.schemes.nystrom(base.system, 6), growing(0.8 * unit, points, 1.4))


def by_diffrax(system: Any, unit: float, **how: Any) -> Iterator[Curve]:
    """Tsit5 and Dopri8, vmapped, and Dopri8 with steps that all members share."""
    tsit5, dopri8 = (peers.diffrax_of(name, system, **how) for name in ("Tsit5", "Dopri8"))
    shared = peers.diffrax_of("Dopri8", system, whole=True, **how)
    yield Curve("diffrax Dopri8, one solve, adaptive", "diffrax", shared, (), _LOOSE)
    yield Curve("diffrax Dopri8", "diffrax", dopri8, growing(2 * unit, 6, 1.6))
    yield Curve("diffrax Tsit5", "diffrax", tsit5, growing(6 * unit, 6, 2))


def moving(attitudes: np.ndarray, velocities: np.ndarray, inertia: Sequence[float]) -> States:
    """Attitudes and body velocities as configurations and momenta."""
    q, Pi = jnp.asarray(attitudes), jnp.asarray(velocities * np.asarray(inertia))
    return np.asarray(q), np.asarray(jax.vmap(so3.Ad)(q, Pi))


def directions(count: int, seed: int, n: int = 3) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(count, n))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def free_body_soon() -> Problem:
    """Free bodies to t = 10, ours in a compiled loop without `li.run`, whose call alone takes longer."""
    body, make = measure.body(), li.schemes
    base = make.so3_midpoint(body)

    def curve(name: str, kind: str, step: li.Step, counts: Sequence[int]) -> Curve:
        return Curve(name, kind, partial(measure.vmapped, name, step), counts)

    mine = [
        curve("κ symplectic", ORDER_2, base, growing(50, 3, 4)),
        *(curve(f"compose {n}", COMPOSED, make.compose(base, n), growing(9, 5, 1.7)) for n in (6, 8, 10)),
        curve("preprocessed 6", PREPROCESSED, make.preprocessed(body, 6), growing(24, 6, 1.9)),
        curve("preprocessed 10", PREPROCESSED, make.preprocessed(body, 10), growing(14, 7, 1.4)),
        curve("exact", EXACT, make.exact(body), (1, 10)),
        curve("calibrated", EXACT, make.calibrated(body), (10, 40)),
    ]
    scipy = Curve("scipy DOP853", "scipy", partial(peers.dop853, INERTIA), (), _LOOSE[1::2], WATCHED)
    return _free("free body, t = 10", 10.0, [*mine, *precision.of_peers(INERTIA, None, 10.0), scipy])


def free_body() -> Problem:
    """Free bodies to t = 1000."""
    body, make = measure.body(), li.schemes
    mine = [
        *composed(make.so3_midpoint(body), ours, 400),
        ours("preprocessed 6", PREPROCESSED, make.preprocessed(body, 6), growing(2000, 5, 2)),
        ours("preprocessed 10", PREPROCESSED, make.preprocessed(body, 10), growing(1400, 5, 1.4)),
        ours("exact", EXACT, make.exact(body), (1, 10)),
        ours("calibrated", EXACT, make.calibrated(body), (1000, 4000)),
        *high_order(body, ours, 800),
    ]
    heyoka = Curve("heyoka", "heyoka", taylor.of_bodies(INERTIA), (), TOLERANCES)
    return _free("free body, t = 1000", 1000.0, [*mine, *by_diffrax(body, 500), heyoka])


def _free(name: str, end: float, curves: Sequence[Curve]) -> Problem:
    """Inertia (1, 2, 3), velocities random in the unit ball; the reference is `RigidBody.solution`."""
    body = measure.body()
    solve = jax.jit(jax.vmap(body.solution, (0, None)))

    def reference(states: States) -> tuple[np.ndarray, np.ndarray, str]:
        exact = np.asarray(solve(li.State(jnp.asarray(states[0]), jnp.asarray(states[1])), end).q)
        return precision.checked(problem, exact, states, "`RigidBody.solution`")

    energy = partial(measure.energy_drift, body)
    problem = Problem(name, "attitude, rad", end, measure.bodies, reference, curves, energy=energy)
    return problem


def heavy_top() -> Problem:
    """Chaotic tops, nearly upright: attitudes exp ξ, ξ normal of 0.3 rad, and velocities of one size, to t = 100."""
    top = li.systems.heavy_top(_TOP, _WEIGHT)
    heyoka = Curve("heyoka", "heyoka", taylor.of_bodies(_TOP, _WEIGHT), (), TOLERANCES)
    mine = [*composed(li.schemes.splitting(top), ours, 160, 7, 3), *high_order(top, ours, 130, 7, 4)]
    curves = [*mine, *by_diffrax(top, 160), heyoka]

    def start(count: int) -> States:
        tilts = _TILT * np.random.default_rng(1).normal(size=(count, 3))
        return moving(np.asarray(jax.vmap(so3.exp)(jnp.asarray(tilts))), _SPEED * directions(count, 2), _TOP)

    def reference(states: States) -> tuple[np.ndarray, np.ndarray, str]:
        # 64 bits do not suffice: with them two good integrators are 6e-10 apart (median)
        exact, second = (taylor.attitudes(_TOP, _WEIGHT, *states, problem.end, rtol) for rtol in (1e-19, 1e-18))
        off = np.median(measure.attitude_errors(flowed(top, states, problem.end, 400), exact))
        said = f"heyoka in 80-bit arithmetic with tolerances of 1e-19 and 1e-18 (`diagnostics.flow`: {off:.1e} off)"
        return exact, measure.attitude_errors(second, exact), said

    energy = partial(measure.energy_drift, top)
    problem = Problem("heavy top, t = 100", "attitude, rad", 100.0, start, reference, curves, energy=energy)
    return problem


def satellite() -> Problem:
    """Satellites on an orbit with e = 0.1, three orbits, see `satellites`."""
    system = satellites.satellite()
    curve = partial(ours, start=satellites.shared)
    mine = [*composed(li.schemes.splitting(system), curve, 40), *high_order(system, curve, 30)]
    curves = [*mine, *by_diffrax(system, 40), *satellites.by_astrojax(4, 4), satellites.by_heyoka()]

    def reference(states: States) -> tuple[np.ndarray, np.ndarray, str]:
        return precision.checked(problem, flowed(system, states, satellites.END, 200, 0.0), states)

    name = "gravity gradient, e = 0.1, three orbits"
    problem = Problem(name, "attitude, rad", satellites.END, measure.bodies, reference, curves)
    return problem


def binary() -> Problem:
    """Didymos and systems like it, two orbits, see `binaries`."""
    system = binaries.binary()
    mine = [curve._replace(kind=TWO_BODY) for curve in reversed(binaries.of_ours(alone=False)[:-1])]
    curves = [*mine, *high_order(system, ours, 24), *by_diffrax(system, 24), binaries.by_heyoka(alone=False)]

    def reference(states: States) -> tuple[np.ndarray, np.ndarray, str]:
        return precision.checked(problem, flowed(system, states, binaries.END, 200), states)

    problem = Problem(
        "Didymos and Dimorphos, two orbits",
        "x₂ − x₁, relative",
        binaries.END,
        binaries.start,
        reference,
        curves,
        binaries.distance_error,
        binaries.energy_drift,
    )
    return problem


def flyby() -> Problem:
    """Asteroids like Apophis that tumble past the Earth, 96 hours before and after; ours with graded steps."""
    mu = li.orbits.EARTH_GM * 3600.0**2 / _NEAREST**3  # per h²
    orbit = li.orbits.kepler(mu, -28400.0 / _NEAREST, 2.35)
    system = li.systems.gravity_gradient(_ASTEROID, orbit)
    times = cache(lambda count: li.orbits.graded_times(orbit, -_FLYBY, _FLYBY, count))

    def begin(z: li.State) -> li.State:
        return z._replace(t=jnp.asarray(-_FLYBY))

    curve = partial(ours, start=begin, times=times)
    heyoka = Curve("heyoka", "heyoka", taylor.of_satellites(_ASTEROID, orbit, -_FLYBY), (), TOLERANCES)
    # few points: each number of given times is a program of its own
    mine = [*composed(li.schemes.splitting(system), curve, 40, 4), *high_order(system, curve, 36, 4)]
    curves = [*mine, *by_diffrax(system, 60, t0=-_FLYBY), heyoka]

    def start(count: int) -> States:
        return moving(directions(count, 1, 4), _TUMBLING * directions(count, 2), _ASTEROID)

    def reference(states: States) -> tuple[np.ndarray, np.ndarray, str]:
        return precision.checked(problem, flowed(system, states, problem.end, 800, -_FLYBY), states)

    problem = Problem("flyby, ± 96 h", "attitude, rad", 2 * _FLYBY, start, reference, curves)
    return problem


ALL = (free_body_soon, free_body, heavy_top, satellite, binary, flyby)


def everything(sizes: precision.Sizes, names: Sequence[str] = ()) -> dict[str, Any]:
    """All results, as values that JSON can hold; of the problems so named in `ALL` only, if any are. On one core."""
    notes: list[str] = []
    found: list[dict[str, Any]] = []
    for make in ALL:
        if not names or make.__name__ in names:
            began = time.perf_counter()
            found.append(precision.measured(make(), sizes, notes))
            print(f"{make.__name__}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
    return {"machine": measure.machine(), "problems": found, "notes": notes}
