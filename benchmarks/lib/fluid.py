"""Kirchhoff's ellipsoid on SE(3): the contestants, their rates, their drifts.

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
from lib.measure import BATCH, DT, END, WATCHED, WIDE

import lieint_jax as li
from lieint_jax.systems._euler import Euler, kirchhoff

_DRIFT_STEPS = 1000  # few: at a distance x from the origin, Π = Ad*_q π loses digits like ε|x|
_MAPS = {"exponential": li.maps.exponential, "Cayley": li.maps.cayley}


def body() -> Euler:
    return kirchhoff((3.0, 2.0, 1.0), center_of_mass=(0.0, 0.0, -0.2))


def bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random motions, and the spatial momenta of random body velocities in the unit ball."""
    place, velocity, radius = (np.random.default_rng(seed) for seed in (1, 2, 3))
    xi, Omega = place.normal(size=(count, 6)), velocity.normal(size=(count, 6))
    Omega *= radius.random((count, 1)) ** (1 / 6) / np.linalg.norm(Omega, axis=1, keepdims=True)
    system = body()
    q = jax.jit(jax.vmap(system.group.exp))(jnp.asarray(xi))
    states = jax.jit(jax.vmap(lambda q, v: system.state(q, velocity=v)))(q, jnp.asarray(Omega))
    return np.asarray(states.q), np.asarray(states.p)


def contestants(missing: list[str]) -> list[Contestant]:
    """All contestants at dt = DT; a note on each one whose package is not installed is appended to `missing`."""
    makers: list[tuple[str, Callable[[], Contestant]]] = []
    for name, tau in _MAPS.items():
        step = li.schemes.group_midpoint(body(), tau)
        makers.append(("ours", partial(measure.ours, f"ours, {name} map", step, DT, pace=1e7)))
    for wide in (False, True):
        makers.append(("diffrax", partial(peers.diffrax_of("Tsit5", body(), wide), DT)))
    return list(measure.those_here(makers, missing))


def reference(end: float) -> tuple[np.ndarray, float]:
    """The watched bodies' q at t = end, and the distance of a second reference, see `measure.by_flow`."""
    return measure.by_flow(body(), bodies(WATCHED), end, largest_difference)


def largest_difference(q: np.ndarray, exact: np.ndarray) -> float:
    """The largest difference of an entry, in radians or lengths."""
    return float(np.abs(q - exact).max())


def energy_drift(system: Euler, q: np.ndarray, p: np.ndarray) -> float:
    """The largest |H − H₀|/H₀ of states (times, bodies, …)."""
    H = np.asarray(jax.jit(jax.vmap(jax.vmap(system.energy)))(li.State(jnp.asarray(q), jnp.asarray(p))))
    return float(np.max(np.abs(H - H[0]) / H[0]))


def everything(sizes: measure.Sizes) -> dict[str, Any]:
    """All results, as values that JSON can hold. Run it on one core."""
    notes: list[str] = []
    sizes = sizes._replace(drift_steps=_DRIFT_STEPS)
    entries = contestants(notes)
    exact, doubt = reference(END)
    return {
        "machine": measure.machine(),
        "rates": measure.rates(entries, BATCH, sizes, bodies),
        "quality": [
            measure.quality(c, exact, sizes, body(), bodies, largest_difference, energy_drift)
            for c in entries
            if WIDE not in c.name
        ],
        "reference_doubt": doubt,
        "notes": notes,
    }
