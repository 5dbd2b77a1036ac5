"""Heavy tops: the contestants, their rates, drifts, and cost against error.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from lib import cpp, kovalevskaya, measure, peers, precision
from lib.contest import Contestant
from lib.measure import BATCH, DT, END, INERTIA, KAPPAS, WATCHED
from lib.precision import Curve, Problem, growing

import lieint_jax as li

WEIGHT = (0.9, 0.8, 0.0)


def top() -> Any:
    return li.systems.heavy_top(np.asarray(INERTIA), np.asarray(WEIGHT))


def schemes() -> dict[str, tuple[li.Step, float]]:
    """Our steps by name, each with a guess of its rate."""
    make, body = li.schemes, top()
    found: dict[str, tuple[li.Step, float]] = {"splitting": (make.splitting(body), 6e7)}
    for kappa in KAPPAS[1:] + KAPPAS[:1]:
        found[f"energy-momentum, {kappa.name} κ"] = make.top_energy_momentum(body, kappa), 1.5e7
    found["splitting, order 4"] = make.compose(make.splitting(body), 4), 1.5e7
    found["energy-momentum, cayley κ, order 4"] = make.compose(make.top_energy_momentum(body), 4), 3e6
    return found


def contestants(missing: list[str]) -> list[Contestant]:
    """All contestants at dt = DT; a note on each one whose package is not installed is appended to `missing`."""
    makers: list[tuple[str, Callable[[], Contestant]]] = [
        ("C++", partial(cpp.top, scheme, INERTIA, WEIGHT, DT)) for scheme in ("splitting", "energy_momentum")
    ]
    for name, (step, pace) in schemes().items():
        makers.append(("ours", partial(measure.ours, f"ours, {name}", step, DT, pace=pace)))
    for peer in (peers.tsit5, peers.dopri8):
        makers.append(("diffrax", partial(peer, INERTIA, DT, weight=WEIGHT)))
    makers.append(("MuJoCo", partial(peers.mujoco_rk4, INERTIA, DT, WEIGHT)))
    return list(measure.those_here(makers, missing))


def everything(sizes: measure.Sizes, points: precision.Sizes) -> dict[str, Any]:
    """All results, as values that JSON can hold. Run it on one core."""
    notes: list[str] = []
    entries = contestants(notes)
    notes += cpp.notes("heavy_top")
    exact, doubt = measure.by_flow(top(), measure.bodies(WATCHED), END)
    pairs = [
        [c for c in entries if c.name in names]
        for names in (
            ("C++ splitting", "ours, splitting"),
            ("C++ energy-momentum", "ours, energy-momentum, cayley κ"),
        )
    ]
    rates = measure.rates(entries, BATCH, sizes)
    return {
        "machine": measure.machine(),
        "accuracy": precision.measured(accuracy(), points, notes),
        "rates": rates,
        "equal_cost": kovalevskaya.at_equal_cost(rates, sizes.drift_steps / 10),
        "quality": [measure.quality(c, exact, sizes, top()) for c in entries],
        "agreement": [r for same in pairs for r in measure.agreement(same, ("float64",))],
        "reference_doubt": doubt,
        "notes": notes,
    }


def accuracy() -> Problem:
    """The curves of our schemes at orders 2, 4 and 6, then of the peers; the references are two runs of the flow."""
    make = li.schemes
    mine: list[Curve] = []
    for name, step in (("splitting", make.splitting(top())), ("energy-momentum", make.top_energy_momentum(top()))):
        mine.append(_ours(name, name, step, growing(25, 6, 2)))
        for order, count in ((4, 12), (6, 10)):
            composed = make.compose(step, order)
            mine.append(_ours(f"{name}, order {order}", f"{name}, composed", composed, growing(16, count)))
    return Problem(
        f"heavy top, t = {END:g}",
        "attitude, rad",
        END,
        measure.bodies,
        lambda states: (
            *measure.by_flow(top(), states, END, measure.attitude_errors),
            "two runs of `diagnostics.flow`",
        ),
        [*mine, *precision.of_peers(INERTIA, WEIGHT, END)],
        energy=partial(measure.energy_drift, top()),
    )


def _ours(name: str, kind: str, step: li.Step, counts: Sequence[int]) -> Curve:
    return Curve(name, kind, partial(measure.ours, name, step), counts)
