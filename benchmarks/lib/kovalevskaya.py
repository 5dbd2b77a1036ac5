"""Kovalevskaya's fourth integral, which no method conserves by design: its drift and energy's at equal cost.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib import measure, peers
from lib.contest import Contestant
from lib.measure import WATCHED

import lieint_jax as li
from lieint_jax.systems._heavy_top import kovalevskaya, kovalevskaya_integral

_DT, _SAVES = 0.01, 200  # step size of the energy-momentum scheme; saved states of a run
_ENERGY_MOMENTUM = "ours, energy-momentum, cayley κ"


def at_equal_cost(rates: list[dict[str, Any]], end: float) -> list[dict[str, Any]]:
    """The drifts until t = end of each method in `rates`, at the step size of equal cost."""
    rate = {r["name"]: r["rate"] for r in rates}
    missing: list[str] = []
    found = []
    for name, make in _methods().items():
        if name not in rate:
            continue
        dt = _DT * rate[_ENERGY_MOMENTUM] / rate[name]
        [contestant] = [*measure.those_here([(name, partial(make, dt))], missing)] or [None]
        if contestant:
            found.append({"name": name, "dt": dt, **_drifts(contestant, dt, end)})
    return found


def _methods() -> dict[str, Callable[[float], Contestant]]:
    """The functions step size ↦ contestant, by the contestant's name in the table of rates."""
    top: Any = kovalevskaya()[0]
    make = li.schemes
    steps = {
        _ENERGY_MOMENTUM: make.top_energy_momentum(top),
        "ours, splitting": make.splitting(top),
        "ours, splitting, order 4": make.compose(make.splitting(top), 4),
    }
    inertia, weight = top.inertia.tolist(), top.potential.weight.tolist()
    return {name: partial(_ours, name, step) for name, step in steps.items()} | {
        "diffrax Tsit5, vmapped": lambda dt: peers.tsit5(inertia, dt, weight=weight),
        "diffrax Dopri8, vmapped": lambda dt: peers.dopri8(inertia, dt, weight=weight),
    }


def _ours(name: str, step: li.Step, dt: float) -> Contestant:
    return measure.ours(name, step, dt)


def _drifts(contestant: Contestant, dt: float, end: float) -> dict[str, Any]:
    """The largest relative errors of energy and K in each half of the run, over tops with several initial speeds."""
    top, first = kovalevskaya()
    speeds = jnp.linspace(0.6, 1.4, WATCHED)[:, None]
    start = np.broadcast_to(first.q, (WATCHED, 4)), np.asarray(speeds * first.p)
    chunk = max(round(end / dt / _SAVES), 1)
    states = [contestant.load(*start)]
    for _ in range(_SAVES):
        states.append(contestant.advance(states[-1], chunk))
    q, p = (np.stack(x) for x in zip(*map(contestant.read, states), strict=True))
    found: dict[str, Any] = {"steps": chunk * _SAVES}
    for name, of in (("energy", top.energy), ("K", partial(kovalevskaya_integral, top))):
        value = np.asarray(jax.vmap(jax.vmap(of))(li.State(jnp.asarray(q), jnp.asarray(p))))
        error = np.abs(value - value[0]) / np.maximum(np.abs(value[0]), 1.0)
        found[name] = [float(half.max()) for half in np.split(error[1:], 2)]
    solved = [contestant.info(z)[1] for z in states[1:]] if contestant.info else None
    found["converged"] = all(solved) if solved else None
    return found
