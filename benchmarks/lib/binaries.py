"""Binary asteroids: the contestants, their time for an accuracy, and the cost of a step against N and B.

The unit of length is the distance of Didymos and Dimorphos, that of mass the sum of theirs, and G = 1: an orbit takes
about 2π. Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from lib import peers, taylor
from lib.contest import Contestant, race
from lib.measure import BATCH, WATCHED, States, ours, read_states, solve_info
from lib.precision import Curve, Sizes, flowed, growing, points_of, records
from lib.taylor import cross, dot, rotate
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax.runs import compiler_options
from lieint_jax.systems import RigidBodies

ORBITS = 2
END = 2 * np.pi * ORBITS
EXTRAPOLATE = "extrapolate, order 14"
_TOLERANCES = tuple(10.0**-k for k in range(5, 15))

# Didymos and Dimorphos, SI units: the example of the public two-body code of Davis & Scheeres
_G, _DISTANCE, _SPEED = 6.67408e-11, 1180.0, 0.17277588
_MASSES = np.array([522941787070.36884, 4842963890.0586843])
_INERTIAS = np.array(
    [
        [31348424975008636, 31920248302583308, 32790416201495100],
        [10438985934293.97, 14689757387650.04, 16572197488200.17],
    ]
)
_SPINS = np.array([7.7226958052846407e-4, 1.4880755e-4])
_TIME = np.sqrt(_DISTANCE**3 / (_G * _MASSES.sum()))


@cache
def binary() -> RigidBodies:
    masses, inertias = _MASSES / _MASSES.sum(), _INERTIAS / (_MASSES.sum() * _DISTANCE**2)
    return li.systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(1.0, masses, inertias))


def start(count: int) -> States:
    """Didymos, then systems whose distances, velocities and spins differ from its by up to 2 %, in every direction."""
    off = 0.02 * np.random.default_rng(1).uniform(-1, 1, (count, 4, 3))
    off[0] = 0
    d = np.array([1.0, 0, 0]) + off[:, 0]
    v = (np.array([0, 1.0, 0]) + off[:, 1]) * _SPEED * _TIME / _DISTANCE
    spins = (np.array([0, 0, 1.0]) + off[:, 2:]) * _SPINS[:, None] * _TIME
    system = binary()
    m, J = np.asarray(system.masses), np.asarray(system.inertias)
    share = np.array([-m[1], m[0]])[:, None]  # of the distance, from the barycenter
    q = np.concatenate([share * d[:, None], np.tile([1.0, 0, 0, 0], (count, 2, 1))], axis=2)
    return q, np.concatenate([m[:, None] * share * v[:, None], J * spins], axis=2)


def looped(name: str, step: li.Step, dt: float) -> Contestant:
    """A step in a compiled loop of any number of steps: one program for all step sizes."""

    def load(q: np.ndarray, p: np.ndarray) -> tuple[li.State, li.StepInfo]:
        return li.State(jnp.asarray(q), jnp.asarray(p)), li.StepInfo(jnp.zeros(len(q)), jnp.ones(len(q), bool))

    def advance(states: tuple[li.State, li.StepInfo], num_steps: int) -> tuple[li.State, li.StepInfo]:
        return jax.block_until_ready(_loop(step, *states, dt, num_steps))

    return Contestant(name, "float64", 1e5, load, advance, read_states, solve_info)


@partial(jax.jit, compiler_options=compiler_options())
def _loop(step: li.Step, states: li.State, info: li.StepInfo, dt: Any, num_steps: Any) -> tuple[li.State, li.StepInfo]:
    def body(_: Any, carry: tuple[li.State, li.StepInfo]) -> tuple[li.State, li.StepInfo]:
        states, last = jax.vmap(lambda z: step(z, dt))(carry[0])
        return states, carry[1].merge(last)

    return lax.fori_loop(0, num_steps, body, (states, info))


def rates_of_relative_motion(m: Sequence[float], J: Any, y: Sequence[Any]) -> list[Any]:
    """The time derivatives of d, ḋ, and q, Π of either body, for numbers and for expressions alike; G = 1."""
    d, v = y[:3], y[3:6]
    square = dot(d, d)
    fifth = square**-2.5
    along, arms, turning = 0.0, [0.0] * 3, []
    for i in range(2):
        q, Pi, other = y[6 + 7 * i : 10 + 7 * i], y[10 + 7 * i : 13 + 7 * i], m[1 - i]
        w = [a / b for a, b in zip(Pi, J[i], strict=True)]
        Gamma = rotate(-1.0 * q[0], q[1:], d)
        JGamma = [a * b for a, b in zip(J[i], Gamma, strict=True)]
        along = along + other * dot(Gamma, JGamma)
        arms = [a + other * b for a, b in zip(arms, rotate(q[0], q[1:], JGamma), strict=True)]
        turning += [-0.5 * dot(q[1:], w)]
        turning += [0.5 * (q[0] * a + b) for a, b in zip(w, cross(q[1:], w), strict=True)]
        torque = cross(Gamma, JGamma)
        turning += [a + 3.0 * other * fifth * b for a, b in zip(cross(Pi, w), torque, strict=True)]
    second = 1.5 * (m[1] * sum(J[0]) + m[0] * sum(J[1]))
    size = fifth * (m[0] * m[1] * square + second - 7.5 * along / square)
    whole = -(1 / m[0] + 1 / m[1])
    return [*v, *(whole * (size * a + 3.0 * fifth * b) for a, b in zip(d, arms, strict=True)), *turning]


def _numbers() -> tuple[list[float], list[list[float]]]:
    system = binary()
    return np.asarray(system.masses).tolist(), np.asarray(system.inertias).tolist()


def to_relative(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """States as d, ḋ, and q, Π of either body, (B, 20)."""
    m, _ = _numbers()
    v = p[:, 1, :3] / m[1] - p[:, 0, :3] / m[0]
    spins = jax.vmap(jax.vmap(li.groups.so3.Ad_star))(*(jnp.asarray(x[:, :, 3:]) for x in (q, p)))
    turning = np.concatenate([q[:, :, 3:], np.asarray(spins)], axis=2)
    return np.concatenate([q[:, 1, :3] - q[:, 0, :3], v, turning.reshape(len(q), 14)], axis=1)


def from_relative(y: np.ndarray) -> States:
    """Configurations (B, 2, 7) and momenta (B, 2, 6) of states (B, 20), the barycenter at rest at the origin."""
    m, _ = _numbers()
    share = np.array([-m[1], m[0]])[:, None]
    q, Pi = np.stack([y[:, 6:10], y[:, 13:17]], axis=1), np.stack([y[:, 10:13], y[:, 17:20]], axis=1)
    spins = jax.vmap(jax.vmap(li.groups.so3.Ad))(jnp.asarray(q), jnp.asarray(Pi))
    x, v = (share * y[:, None, first : first + 3] for first in (0, 3))
    return np.concatenate([x, q], axis=2), np.concatenate([np.array(m)[:, None] * v, np.asarray(spins)], axis=2)


def relative_motion(heyoka: Any) -> list[Any]:
    """The equations of the relative motion, for `taylor`."""
    variables = heyoka.make_vars(*(f"y{k}" for k in range(20)))
    return list(zip(variables, rates_of_relative_motion(*_numbers(), variables), strict=True))


def dop853(dt: float, rtol: float) -> Contestant:
    """scipy's DOP853 of the relative motion in plain floats, rtol = atol, one system after the other."""
    m, J = _numbers()

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        def field(_: float, y: np.ndarray) -> list[float]:
            return rates_of_relative_motion(m, J, y.tolist())

        span = (0.0, num_steps * dt)
        return np.stack([solve_ivp(field, span, y, method="DOP853", rtol=rtol, atol=rtol).y[:, -1] for y in states])

    return Contestant("scipy DOP853", "float64", 1e2, to_relative, advance, from_relative)


def of_ours(alone: bool) -> list[Curve]:
    """The curves of our schemes; of one system `alone`, or of many. Counts are of both orbits; the last has no form."""
    make, system = li.schemes, binary()
    turns = make.preprocessed(system.free, 10)

    def curve(name: str, step: li.Step, first: int, points: int, factor: float = 2**0.5) -> Curve:
        made = partial(looped, name, step) if alone else partial(ours, name, step)
        return Curve(name, "ours", made, growing(first, points, factor))

    return [
        curve("splitting", make.splitting(system), 200, 3, 4),
        curve("nystrom, order 4", make.nystrom(system, 4), 64, 8),
        curve("nystrom, order 6", make.nystrom(system, 6), 24, 8),
        curve("nystrom 6, preprocessed turns", make.nystrom(system, 6, turns), 24, 8),
        curve("kepler_splitting (8, 4)", make.kepler_splitting(system, (8, 4)), 12, 9),
        curve("kepler_splitting (8, 6, 4)", make.kepler_splitting(system, (8, 6, 4)), 8, 9),
        curve("kepler (8, 6, 4), preprocessed turns", make.kepler_splitting(system, (8, 6, 4), drift=turns), 8, 9),
        curve(EXTRAPOLATE, make.extrapolate(system, 14), 24, 7, 1.2),
    ]


def by_heyoka(alone: bool) -> Curve:
    make = partial(taylor.one_system if alone else taylor.many_systems, relative_motion, to_relative, from_relative)
    return Curve("heyoka", "heyoka", make, (), _TOLERANCES)


def curves(alone: bool) -> list[Curve]:
    """The curves of our schemes, then of the peers; of one system `alone`, or of many."""
    diffrax = [
        Curve(f"diffrax {name}{how}", "diffrax", _diffrax(name), counts, tolerances)
        for name, steps in (("Tsit5", growing(128, 9)), ("Dopri8", growing(24, 9)))
        for how, counts, tolerances in (("", steps, ()), (", adaptive", (), _TOLERANCES))
    ]
    scipy = [Curve("scipy DOP853", "scipy", dop853, (), _TOLERANCES[::2])] if alone else []
    return [*of_ours(alone), *diffrax, by_heyoka(alone), *scipy]


@cache
def _diffrax(name: str) -> Any:
    return peers.diffrax_of(name, binary())


def distance_error(q: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """The errors |d − d*|/|d*| of configurations (B, 2, 7), d = x₂ − x₁."""
    d, right = (x[:, 1, :3] - x[:, 0, :3] for x in (q, exact))
    return np.linalg.norm(d - right, axis=1) / np.linalg.norm(right, axis=1)


def energy_drift(q: np.ndarray, p: np.ndarray) -> float:
    """The largest |H − H₀|/|H₀| of states (times, systems, …)."""
    H = np.asarray(jax.jit(jax.vmap(jax.vmap(binary().energy)))(li.State(jnp.asarray(q), jnp.asarray(p))))
    return float(np.max(np.abs(H - H[0]) / np.abs(H[0])))


def reference() -> tuple[np.ndarray, np.ndarray]:
    """Configurations of the watched systems at the end by `diagnostics.flow`, and the distance of those of DOP853."""
    states = start(WATCHED)
    exact = flowed(binary(), states, END, round(16 * END))
    scipy = dop853(END, 1e-13)
    return exact, distance_error(scipy.read(scipy.advance(scipy.load(*states), 1))[0], exact)


def accuracy(rounds: int, stride: int, notes: list[str]) -> dict[str, Any]:
    """Times and errors of all points, with 1000 systems and with one; the errors are those of the watched ones."""
    exact, doubts = reference()
    found: dict[str, Any] = {"end": END, "reference_doubt": float(doubts.max())}
    extent = Sizes(rounds=rounds, longest=np.inf, seconds=np.inf)
    for key, count in (("many", BATCH), ("one", 1)):
        points = [x for curve in curves(count == 1) for x in points_of(curve, END, stride, notes)]
        found[key] = records(points, start(count), exact, doubts, extent, notes, distance_error)
        for record in found[key]:
            record["milliseconds"] *= count / 1000  # of all systems
    found["heyoka_compile_seconds"] = _compile_seconds(stride)
    return found


def _compile_seconds(stride: int) -> float | None:
    """The most seconds that heyoka took to compile its batch for one of the tolerances."""
    try:
        return max(taylor.compiled(relative_motion, rtol)[1] for rtol in _TOLERANCES[::stride])
    except ImportError:
        return None


def scattered(count: int) -> tuple[RigidBodies, li.State]:
    """Bodies on a lattice with a spacing of 10, and their motion; for the cost of a step, not for its physics."""
    side = np.arange(np.ceil(count ** (1 / 3)))
    places = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)[:count] * 10.0
    masses, inertias = np.ones(count), np.tile([1.0, 1.1, 1.3], (count, 1))
    system = li.systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(1.0, masses, inertias))
    spins = np.random.default_rng(2).normal(size=(count, 3))
    return system, system.state(places - places.mean(axis=0), angular_velocities=0.1 * spins)


def growth_with_bodies(counts: Sequence[int], seconds: float) -> list[dict[str, Any]]:
    """Seconds and bytes of a step of `splitting`, one system of so many bodies."""
    found = []
    for count in counts:
        system, state = scattered(count)
        step = li.schemes.splitting(system)
        arguments = (step, jax.tree.map(lambda x: x[None], state), li.StepInfo(jnp.zeros(1), jnp.ones(1, bool)), 1e-3)
        found.append({"bodies": count, **_cost(arguments, seconds)})
    return found


def growth_with_systems(counts: Sequence[int], seconds: float) -> list[dict[str, Any]]:
    """Seconds and bytes of a step of each of so many binaries with `splitting`, in one loop and in `li.run`."""
    found, step = [], li.schemes.splitting(binary())
    for count in counts:
        q, p = start(count)
        states = li.State(jnp.asarray(q), jnp.asarray(p))
        info = li.StepInfo(jnp.zeros(count), jnp.ones(count, bool))
        record = _cost((step, states, info, 0.01), seconds)
        contestant = ours("", step, 0.01)
        steps = max(4, round(seconds / record["seconds"]))
        [timing] = race([contestant], q, p, [steps], 3)
        found.append({"systems": count, **record, "ensemble_seconds": min(timing.later) / steps})
    return found


def _cost(arguments: tuple[Any, ...], seconds: float) -> dict[str, float]:
    """Seconds of a step, the best of three runs of about `seconds`, and bytes beside the states and the step."""
    compiled: Any = _loop.lower(*arguments, 1).compile()

    def lasting(num_steps: int) -> float:
        began = time.perf_counter()
        jax.block_until_ready(compiled(*arguments, num_steps))
        return time.perf_counter() - began

    lasting(1)
    steps = int(np.clip(seconds / lasting(1), 2, 10_000))
    return {
        "seconds": min(lasting(steps) for _ in range(3)) / steps,
        "bytes": compiled.memory_analysis().temp_size_in_bytes,
    }
