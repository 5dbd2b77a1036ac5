"""Satellites under gravity's gradient: the contestants, their rates, and cost against error.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib import measure, peers, precision, taylor, tops
from lib.contest import Contestant
from lib.measure import BATCH, DT, INERTIA, WATCHED
from lib.precision import TOLERANCES, Curve, flowed, growing, points_of
from scipy.integrate import solve_ivp

import lieint_jax as li

ECCENTRICITY, ORBITS = 0.1, 3
END = 2 * np.pi * ORBITS
TOP, SHARED = "ours, heavy top", "ours, satellite, shared t"
COUNTED, APART = "ours, satellite, shared t, work counted", "ours, satellite, t per member"


@cache
def orbit() -> Any:
    return li.orbits.kepler(1.0, 1.0, ECCENTRICITY)


@cache
def satellite() -> Any:
    return li.systems.gravity_gradient(np.asarray(INERTIA), orbit())


def shared(z: li.State) -> li.State:
    return z._replace(t=jnp.zeros(()))


def counted(z: li.State) -> li.State:
    return shared(z)._replace(work=jnp.zeros(len(z.q)))


def with_own_times(z: li.State) -> li.State:
    """Each member has a time of its own; the first starts at 0."""
    return z._replace(t=jnp.linspace(0.0, 1.0, len(z.q)))


def contestants(missing: list[str]) -> list[Contestant]:
    """All contestants at dt = DT; a note on each one whose package is not installed is appended to `missing`."""
    top, body = (li.schemes.splitting(system) for system in (tops.top(), satellite()))
    makers: list[tuple[str, Callable[[], Contestant]]] = [
        ("ours", partial(measure.ours, name, step, DT, start, pace))
        for name, step, start, pace in (
            (TOP, top, lambda z: z, 4e7),
            (SHARED, body, shared, 3e7),
            (COUNTED, body, counted, 3e7),
            (APART, body, with_own_times, 4e6),
        )
    ]
    makers += [("diffrax", partial(peers.diffrax_of("Tsit5", satellite(), whole=whole), DT)) for whole in (False, True)]
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
        Curve(name, "ours", partial(measure.ours, name, step, start=shared), counts) for name, step, counts in steps
    ]
    tsit5, dopri8 = (peers.diffrax_of(name, body, whole=True) for name in ("Tsit5", "Dopri8"))
    return [
        *ours,
        Curve("diffrax Tsit5, one solve", "diffrax", tsit5, growing(90, 11)),
        Curve("diffrax Dopri8, one solve", "diffrax", dopri8, growing(36, 11)),
        Curve("diffrax Dopri8, adaptive", "diffrax", peers.diffrax_of("Dopri8", body), (), TOLERANCES[:-1]),
        *by_astrojax(6, 4),
        by_heyoka(),
    ]


def by_astrojax(constant: int, adaptive: int) -> list[Curve]:
    """The curves of astrojax, with so many points each."""
    make = partial(peers.astrojax_of, INERTIA, orbit())
    return [
        Curve("astrojax RK4", "astrojax", make, growing(180, constant, 2)),
        Curve("astrojax DP54, adaptive", "astrojax", make, (), TOLERANCES[: 2 * adaptive : 2]),
    ]


def by_heyoka() -> Curve:
    return Curve("heyoka", "heyoka", taylor.of_satellites(INERTIA, orbit(), 0.0), (), TOLERANCES)


def everything(sizes: measure.Sizes, stride: int) -> dict[str, Any]:
    """All results, as values that JSON can hold; every `stride`-th point of a curve. Run it on one core."""
    notes: list[str] = []
    rates = measure.rates(contestants(notes), BATCH, sizes)
    points = [x for curve in curves() for x in points_of(curve, END, stride, notes)]
    exact, doubts = reference()
    extent = precision.Sizes(rounds=max(sizes.rounds // 2, 1), longest=np.inf, seconds=np.inf)
    return {
        "machine": measure.machine(),
        "rates": rates,
        "end": END,
        "reference_doubt": float(doubts.max()),
        "points": precision.records(points, measure.bodies(BATCH), exact, doubts, extent, notes),
        "notes": notes,
    }


def reference() -> tuple[np.ndarray, np.ndarray]:
    """Attitudes of the watched bodies at the end by `diagnostics.flow`, and their distance from those of DOP853."""
    q, p = measure.bodies(WATCHED)
    exact = flowed(satellite(), (q, p), END, round(8 * END), 0.0)

    @jax.jit
    def field(t: Any, y: Any) -> Any:
        rate = satellite().vector_field(li.State(y[:4], y[4:], t))
        return jnp.concatenate([rate.q, rate.p])

    second = [
        solve_ivp(field, (0, END), np.concatenate(z), method="DOP853", rtol=1e-13, atol=1e-13).y[:4, -1]
        for z in zip(q, p, strict=True)
    ]
    return exact, measure.attitude_errors(np.stack(second), exact)
