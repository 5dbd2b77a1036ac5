"""Satellites under gravity's gradient: the contestants, their rates, and cost against error.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib import measure, peers, tops
from lib.contest import Contestant, race
from lib.measure import BATCH, DT, INERTIA, WATCHED
from lib.precision import Curve, Point, growing
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import ensemble

ECCENTRICITY, ORBITS = 0.1, 3
END = 2 * np.pi * ORBITS
TOP, SHARED = "ours, heavy top", "ours, satellite, shared t"
COUNTED, APART = "ours, satellite, shared t, work counted", "ours, satellite, t per member"
_TOLERANCES = tuple(10.0**-k for k in range(4, 15))


@cache
def orbit() -> Any:
    return li.orbits.kepler(1.0, 1.0, ECCENTRICITY)


@cache
def satellite() -> Any:
    return li.systems.gravity_gradient(np.asarray(INERTIA), orbit())


def by_ensemble(name: str, step: li.Step, dt: float, start: Callable[[li.State], li.State], pace: float) -> Contestant:
    """A step through `ensemble.run`; `start` adds to states (q, p) what else the initial ones hold."""

    def load(q: np.ndarray, p: np.ndarray) -> tuple[li.State, Any]:
        return start(li.State(jnp.asarray(q), jnp.asarray(p))), None

    def advance(states: tuple[li.State, Any], num_steps: int) -> tuple[li.State, Any]:
        run = ensemble.run(step, states[0], dt, num_steps, progress=False)
        return jax.tree.map(lambda x: x[-1], (run.state, run.info))

    def read(states: tuple[li.State, Any]) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(states[0].q), np.asarray(states[0].p)

    def info(states: tuple[li.State, Any]) -> tuple[float, bool]:
        return float(np.max(states[1].residual)), bool(np.all(states[1].converged))

    return Contestant(name, "float64", pace, load, advance, read, info)


def shared(z: li.State) -> li.State:
    return z._replace(t=jnp.zeros(()))


def counted(z: li.State) -> li.State:
    return shared(z)._replace(work=jnp.zeros(len(z.q)))


def apart(z: li.State) -> li.State:
    """Each member has a time of its own; the first starts at 0."""
    return z._replace(t=jnp.linspace(0.0, 1.0, len(z.q)))


def contestants(missing: list[str]) -> list[Contestant]:
    """All contestants at dt = DT; a note on each one whose package is not installed is appended to `missing`."""
    top, body = (li.schemes.splitting(system) for system in (tops.top(), satellite()))
    makers: list[tuple[str, Callable[[], Contestant]]] = [
        ("ours", partial(by_ensemble, name, step, DT, start, pace))
        for name, step, start, pace in (
            (TOP, top, lambda z: z, 4e7),
            (SHARED, body, shared, 3e7),
            (COUNTED, body, counted, 3e7),
            (APART, body, apart, 4e6),
        )
    ]
    makers += [("diffrax", partial(peers.tsit5_of, satellite(), DT, True, whole=whole)) for whole in (False, True)]
    makers.append(("astrojax", partial(peers.astrojax_of, INERTIA, orbit(), DT)))
    return list(measure.those_here(makers, missing))


def curves() -> list[Curve]:
    """The curves of our schemes, then of the peers; numbers of steps are those of all orbits."""
    make, body = li.schemes, satellite()
    splitting, kept = make.splitting(body), make.top_energy_momentum(body)
    steps = [("splitting", splitting, growing(240, 7, 2)), ("energy-momentum", kept, growing(240, 5, 2))]
    steps += [(f"splitting, order {n}", make.compose(splitting, n), growing(180, 8)) for n in (4, 6, 8)]
    steps += [("energy-momentum, order 4", make.compose(kept, 4), growing(240, 5))]
    ours = [
        Curve(name, "ours", partial(measure.ours, name, step, wide=True, t=0.0), counts) for name, step, counts in steps
    ]
    whole = partial(peers.tsit5_of, body, wide=True, whole=True)
    return [
        *ours,
        Curve("diffrax Tsit5, one solve", "peer", whole, growing(90, 11)),
        Curve("diffrax Dopri8, one solve", "peer", partial(whole, name="Dopri8"), growing(36, 11)),
        Curve(
            "diffrax Dopri8, adaptive", "peer", partial(peers.tsit5_of, body, wide=True, name="Dopri8"), (), _TOLERANCES
        ),
        Curve("astrojax RK4", "peer", partial(peers.astrojax_of, INERTIA, orbit()), growing(180, 6, 2)),
        Curve("astrojax DP54, adaptive", "peer", partial(peers.astrojax_of, INERTIA, orbit()), (), _TOLERANCES[:7:2]),
        Curve("heyoka", "peer", partial(peers.heyoka_taylor, INERTIA, ECCENTRICITY), (), _TOLERANCES),
    ]


def everything(sizes: measure.Sizes, stride: int) -> dict[str, Any]:
    """All results, as values that JSON can hold; every `stride`-th point of a curve. Run it on one core."""
    notes: list[str] = []
    rates = measure.rates(contestants(notes), BATCH, sizes)
    points = [x for curve in curves() for x in points_of(curve, END, stride, notes)]
    exact, doubt = reference()
    return {
        "machine": measure.machine(),
        "rates": rates,
        "end": END,
        "reference_doubt": doubt,
        "points": at_the_end(points, max(sizes.rounds // 2, 1), exact, doubt),
        "notes": notes,
    }


def points_of(curve: Curve, end: float, stride: int, notes: list[str]) -> list[Point]:
    """Every `stride`-th point of a curve to t = end; if its package is not installed, none, and a note is appended."""
    try:
        if curve.tolerances:
            return [Point(curve, curve.make(dt=end, rtol=rtol), 1, rtol) for rtol in curve.tolerances[::stride]]
        return [Point(curve, curve.make(dt=end / n), n, end / n) for n in curve.counts[::stride]]
    except ImportError as error:
        notes.append(f"{curve.name} left out: {error}")
        return []


def at_the_end(
    points: Sequence[Point],
    rounds: int,
    exact: np.ndarray,
    doubt: float,
    start: measure.States | None = None,
    apart: Callable[[np.ndarray, np.ndarray], float] = measure.attitude_error,
) -> list[dict[str, Any]]:
    """Milliseconds of the whole batch, the best call of each point in turn, and the errors of those watched."""
    q, p = start or measure.bodies(BATCH)
    timings = race([x.contestant for x in points], q, p, [x.steps for x in points], rounds)
    records = []
    for point, timing in zip(points, timings, strict=True):
        contestant = point.contestant
        end = contestant.advance(contestant.load(q, p), point.steps)
        errors = [apart(a[None], b[None]) for a, b in zip(contestant.read(end)[0], exact, strict=False)]
        records.append(
            {
                "curve": point.curve.name,
                "kind": point.curve.kind,
                "adaptive": bool(point.curve.tolerances),
                "setting": point.setting,
                "milliseconds": 1e3 * min(timing.later),
                "error": max(*errors, doubt),
                "median_error": max(float(np.median(errors)), doubt),
                "converged": contestant.info(end)[1] if contestant.info else None,
            }
        )
    return records


def reference() -> tuple[np.ndarray, float]:
    """Attitudes of the watched bodies at the end by `diagnostics.flow`, and their distance from those of DOP853."""
    q, p = measure.bodies(WATCHED)
    states = shared(li.State(jnp.asarray(q), jnp.asarray(p)))
    flow = jax.jit(jax.vmap(li.diagnostics.flow, (None, li.State(0, 0, None), None, None)), static_argnums=3)  # pyright: ignore[reportArgumentType]
    exact = np.asarray(flow(satellite(), states, END, round(8 * END)).q)

    @jax.jit
    def field(t: Any, y: Any) -> Any:
        rate = satellite().vector_field(li.State(y[:4], y[4:], t))
        return jnp.concatenate([rate.q, rate.p])

    second = [
        solve_ivp(field, (0, END), np.concatenate(z), method="DOP853", rtol=1e-13, atol=1e-13).y[:4, -1]
        for z in zip(q, p, strict=True)
    ]
    return exact, measure.attitude_error(np.stack(second), exact)
