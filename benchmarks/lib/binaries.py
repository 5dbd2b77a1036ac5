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
from lib import peers
from lib.contest import Contestant, race
from lib.measure import BATCH, WATCHED, States
from lib.precision import Curve, Point, growing
from lib.satellites import at_the_end, by_ensemble, points_of
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax.ensemble import compiler_options
from lieint_jax.systems import RigidBodies

ORBITS = 2
END = 2 * np.pi * ORBITS
_TOLERANCES = tuple(10.0**-k for k in range(5, 15))
_LANES = 8  # of heyoka's batch: 512-bit vectors

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
    share = np.array([-m[1], m[0]])[:, None]  # of the distance, from the barycentre
    q = np.concatenate([share * d[:, None], np.tile([1.0, 0, 0, 0], (count, 2, 1))], axis=2)
    return q, np.concatenate([m[:, None] * share * v[:, None], J * spins], axis=2)


def looped(name: str, step: li.Step, dt: float) -> Contestant:
    """A step in a compiled loop of any number of steps: one program for all step sizes."""

    def load(q: np.ndarray, p: np.ndarray) -> tuple[li.State, li.StepInfo]:
        return li.State(jnp.asarray(q), jnp.asarray(p)), li.StepInfo(jnp.zeros(len(q)), jnp.ones(len(q), bool))

    def advance(states: tuple[li.State, li.StepInfo], num_steps: int) -> tuple[li.State, li.StepInfo]:
        return jax.block_until_ready(_loop(step, *states, dt, num_steps))

    def read(states: tuple[li.State, li.StepInfo]) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(states[0].q), np.asarray(states[0].p)

    def info(states: tuple[li.State, li.StepInfo]) -> tuple[float, bool]:
        return float(states[1].residual.max()), bool(states[1].converged.all())

    return Contestant(name, "float64", 1e5, load, advance, read, info)


@partial(jax.jit, compiler_options=compiler_options())
def _loop(step: li.Step, states: li.State, info: li.StepInfo, dt: Any, num_steps: Any) -> tuple[li.State, li.StepInfo]:
    def one(_: Any, carry: tuple[li.State, li.StepInfo]) -> tuple[li.State, li.StepInfo]:
        states, last = jax.vmap(lambda z: step(z, dt))(carry[0])
        return states, carry[1].merge(last)

    return lax.fori_loop(0, num_steps, one, (states, info))


def rates_of_relative_motion(m: Sequence[float], J: Any, y: Sequence[Any]) -> list[Any]:
    """The time derivatives of d, ḋ, and q, Π of either body, for numbers and for expressions alike; G = 1."""
    d, v = y[:3], y[3:6]
    square = _dot(d, d)
    fifth = square**-2.5
    along, arms, turning = 0.0, [0.0] * 3, []
    for i in range(2):
        q, Pi, other = y[6 + 7 * i : 10 + 7 * i], y[10 + 7 * i : 13 + 7 * i], m[1 - i]
        w = [a / b for a, b in zip(Pi, J[i], strict=True)]
        Gamma = _turned(-1.0 * q[0], q[1:], d)
        JGamma = [a * b for a, b in zip(J[i], Gamma, strict=True)]
        along = along + other * _dot(Gamma, JGamma)
        arms = [a + other * b for a, b in zip(arms, _turned(q[0], q[1:], JGamma), strict=True)]
        turning += [-0.5 * _dot(q[1:], w)]
        turning += [0.5 * (q[0] * a + b) for a, b in zip(w, _cross(q[1:], w), strict=True)]
        torque = _cross(Gamma, JGamma)
        turning += [a + 3.0 * other * fifth * b for a, b in zip(_cross(Pi, w), torque, strict=True)]
    second = 1.5 * (m[1] * sum(J[0]) + m[0] * sum(J[1]))
    size = fifth * (m[0] * m[1] * square + second - 7.5 * along / square)
    whole = -(1 / m[0] + 1 / m[1])
    return [*v, *(whole * (size * a + 3.0 * fifth * b) for a, b in zip(d, arms, strict=True)), *turning]


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _turned(w: Any, v: Sequence[Any], u: Sequence[Any]) -> list[Any]:
    """u turned by the quaternion (w, v)."""
    t = [2.0 * x for x in _cross(v, u)]
    return [a + w * b + c for a, b, c in zip(u, t, _cross(v, t), strict=True)]


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


def from_relative(y: np.ndarray) -> np.ndarray:
    """Configurations (B, 2, 7) of states (B, 20), the barycentre at the origin."""
    m, _ = _numbers()
    x = np.array([-m[1], m[0]])[:, None] * y[:, None, :3]
    return np.concatenate([x, np.stack([y[:, 6:10], y[:, 13:17]], axis=1)], axis=2)


def heyoka_taylor(dt: float, rtol: float) -> Contestant:
    """heyoka's adaptive Taylor series of the relative motion, eight systems at once; its "step" is a time dt."""
    integrator, _ = _heyoka(rtol)

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        ends = np.empty_like(states)
        for first in range(0, len(states), _LANES):
            some = states[first : first + _LANES]
            integrator.state[:] = np.resize(some, (_LANES, 20)).T
            integrator.set_time(0.0)
            integrator.propagate_until(num_steps * dt)
            ends[first : first + _LANES] = integrator.state.T[: len(some)]
        return ends

    def read(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return from_relative(states), states

    return Contestant("heyoka", "float64", 1e4, to_relative, advance, read)


@cache
def _heyoka(rtol: float) -> tuple[Any, float]:
    """The integrator of a batch, and the seconds that it took to compile."""
    import heyoka

    began = time.perf_counter()
    variables = heyoka.make_vars(*(f"y{k}" for k in range(20)))
    equations = list(zip(variables, rates_of_relative_motion(*_numbers(), variables), strict=True))
    made: Any = heyoka.taylor_adaptive_batch(equations, np.zeros((20, _LANES)), tol=rtol)
    return made, time.perf_counter() - began


def heyoka_alone(dt: float, rtol: float) -> Contestant:
    """heyoka's adaptive Taylor series of one system."""
    import heyoka

    variables = heyoka.make_vars(*(f"y{k}" for k in range(20)))
    equations = list(zip(variables, rates_of_relative_motion(*_numbers(), variables), strict=True))
    integrator: Any = heyoka.taylor_adaptive(equations, np.zeros(20), tol=rtol)

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        integrator.state[:] = states[0]
        integrator.time = 0.0
        integrator.propagate_until(num_steps * dt)
        return integrator.state[None].copy()

    return Contestant("heyoka", "float64", 1e4, to_relative, advance, lambda states: (from_relative(states), states))


def dop853(dt: float, rtol: float) -> Contestant:
    """scipy's DOP853 of the relative motion in plain floats, rtol = atol, one system after the other."""
    m, J = _numbers()

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        def field(_: float, y: np.ndarray) -> list[float]:
            return rates_of_relative_motion(m, J, y.tolist())

        span = (0.0, num_steps * dt)
        return np.stack([solve_ivp(field, span, y, method="DOP853", rtol=rtol, atol=rtol).y[:, -1] for y in states])

    return Contestant(
        "scipy DOP853", "float64", 1e2, to_relative, advance, lambda states: (from_relative(states), states)
    )


@cache
def _solver(name: str, adaptive: bool) -> Any:
    return peers.compiled(name, binary(), adaptive, wide=True)


def diffrax_of(name: str, dt: float, rtol: float | None = None) -> Contestant:
    """A solver of diffrax on our right-hand side, vmapped."""
    return peers.by_diffrax(name, _solver(name, rtol is not None), dt, "float64", rtol, pace=1e4)


def curves(alone: bool) -> list[Curve]:
    """The curves of our schemes, then of the peers; of one system `alone`, or of many. Counts are of both orbits."""
    make, system = li.schemes, binary()

    def of(name: str, step: li.Step, first: int, points: int, factor: float = 2**0.5) -> Curve:
        made = partial(looped, name, step) if alone else partial(_in_ensemble, name, step)
        return Curve(name, "ours", made, growing(first, points, factor))

    ours = [
        of("splitting", make.splitting(system), 200, 3, 4),
        of("nystrom, order 4", make.nystrom(system, 4), 64, 8),
        of("nystrom, order 6", make.nystrom(system, 6), 24, 8),
        of("kepler_splitting (8, 4)", make.kepler_splitting(system, (8, 4)), 12, 9),
        of("kepler_splitting (8, 6, 4)", make.kepler_splitting(system, (8, 6, 4)), 8, 9),
    ]
    diffrax = [
        Curve(f"diffrax {name}{how}", "peer", partial(diffrax_of, name), counts, tolerances)
        for name, steps in (("Tsit5", growing(128, 9)), ("Dopri8", growing(24, 9)))
        for how, counts, tolerances in (("", steps, ()), (", adaptive", (), _TOLERANCES))
    ]
    heyoka = Curve("heyoka", "peer", heyoka_alone if alone else heyoka_taylor, (), _TOLERANCES)
    scipy = [Curve("scipy DOP853", "peer", dop853, (), _TOLERANCES[::2])] if alone else []
    return [*ours, *diffrax, heyoka, *scipy]


def _in_ensemble(name: str, step: li.Step, dt: float) -> Contestant:
    return by_ensemble(name, step, dt, lambda z: z, 1e5)


def apart(q: np.ndarray, exact: np.ndarray) -> float:
    """The largest |d − d*|/|d*| of configurations (B, 2, 7), d = x₂ − x₁."""
    d, right = (x[:, 1, :3] - x[:, 0, :3] for x in (q, exact))
    return float(np.max(np.linalg.norm(d - right, axis=1) / np.linalg.norm(right, axis=1)))


def reference() -> tuple[np.ndarray, float]:
    """Configurations of the watched systems at the end by `diagnostics.flow`, and the distance of those of DOP853."""
    q, p = start(WATCHED)
    flow = jax.jit(jax.vmap(li.diagnostics.flow, (None, 0, None, None)), static_argnums=3)
    exact = np.asarray(flow(binary(), li.State(jnp.asarray(q), jnp.asarray(p)), END, round(16 * END)).q)
    scipy = dop853(END, 1e-13)
    return exact, apart(scipy.read(scipy.advance(scipy.load(q, p), 1))[0], exact)


def accuracy(rounds: int, stride: int, notes: list[str]) -> dict[str, Any]:
    """Times and errors of all points, with 1000 systems and with one; the errors are those of the watched ones."""
    exact, doubt = reference()
    found: dict[str, Any] = {"end": END, "reference_doubt": doubt}
    for key, count in (("many", BATCH), ("one", 1)):
        points: list[Point] = []
        for curve in curves(count == 1):
            points += points_of(curve, END, stride, notes)
        found[key] = at_the_end(points, rounds, exact[:count], doubt, start(count), apart)
    found["heyoka_compile_seconds"] = _compile_seconds(stride)
    return found


def _compile_seconds(stride: int) -> float | None:
    """The most seconds that heyoka took to compile its batch for one of the tolerances."""
    try:
        return max(_heyoka(rtol)[1] for rtol in _TOLERANCES[::stride])
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
    """Seconds and bytes of a step of each of so many binaries with `splitting`, in one loop and in `ensemble.run`."""
    found, step = [], li.schemes.splitting(binary())
    for count in counts:
        q, p = start(count)
        states = li.State(jnp.asarray(q), jnp.asarray(p))
        info = li.StepInfo(jnp.zeros(count), jnp.ones(count, bool))
        record = _cost((step, states, info, 0.01), seconds)
        contestant = _in_ensemble("", step, 0.01)
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
