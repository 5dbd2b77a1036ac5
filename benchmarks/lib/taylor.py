"""heyoka as a contestant: adaptive Taylor series, compiled for each set of equations and each tolerance.

Eight bodies are integrated at once, a lane of a 512-bit vector each: that was faster than four and sixteen, and the
compact mode took 1.7 to 2.5 times as long; fast_math and high_accuracy make no difference. Attitudes are quaternions
with body momenta; where there is an orbit, its motion is integrated along, which is faster there than Kepler's
equation. A "step" is a time dt.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from lib.contest import Contestant
from lib.peers import to_body, to_space

_LANES = 8

Equations = Callable[[Any], list[Any]]  # heyoka's module ↦ pairs of a variable and its time derivative
Load = Callable[[np.ndarray, np.ndarray], np.ndarray]  # configurations and momenta ↦ the variables of each member
Read = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@cache
def compiled(equations: Equations, rtol: float) -> tuple[Any, float]:
    """The integrator of a batch, and the seconds that it took to compile; the tolerance is `rtol`."""
    import heyoka

    began, pairs = time.perf_counter(), equations(heyoka)
    made: Any = heyoka.taylor_adaptive_batch(pairs, np.zeros((len(pairs), _LANES)), tol=rtol)
    return made, time.perf_counter() - began


def many_systems(equations: Equations, load: Load, read: Read, dt: float, rtol: float) -> Contestant:
    """A batch of any size, eight members after the other; its states are (blocks, variables, 8)."""
    batch, _ = compiled(equations, rtol)
    members = 0

    def in_lanes(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        nonlocal members
        rows = load(q, p)
        members = len(rows)
        filled = np.resize(rows, (-(-members // _LANES) * _LANES, rows.shape[1]))
        return np.ascontiguousarray(filled.reshape(-1, _LANES, rows.shape[1]).swapaxes(1, 2))

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        ends, now = np.empty_like(states), batch.state
        for some, end in zip(states, ends, strict=True):
            now[:] = some
            batch.set_time(0.0)
            batch.propagate_until(num_steps * dt)
            end[:] = now
        return ends

    def out_of_lanes(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return read(states.swapaxes(1, 2).reshape(-1, states.shape[1])[:members])

    return Contestant("heyoka", "float64", 1e4, in_lanes, advance, out_of_lanes)


def one_system(equations: Equations, load: Load, read: Read, dt: float, rtol: float) -> Contestant:
    """A single member."""
    import heyoka

    pairs = equations(heyoka)
    integrator: Any = heyoka.taylor_adaptive(pairs, np.zeros(len(pairs)), tol=rtol)

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        integrator.state[:] = states[0]
        integrator.time = 0.0
        integrator.propagate_until(num_steps * dt)
        return integrator.state[None].copy()

    return Contestant("heyoka", "float64", 1e4, load, advance, read)


def attitudes(
    inertia: Sequence[float], weight: Sequence[float], q: np.ndarray, p: np.ndarray, end: float, rtol: float
) -> np.ndarray:
    """Attitudes of tops at the end in 80-bit arithmetic, one after the other: a reference for chaotic ones.

    A rounding of the initial body momenta to 64 bits would already show: they are made from (q, p) in 80 bits.
    """
    import heyoka

    wide = np.longdouble
    q = q.astype(wide)
    q /= np.sqrt((q * q).sum(axis=1, keepdims=True))
    Pi = np.stack(rotate(q[:, 0], [*-q[:, 1:].T], [*p.astype(wide).T]), axis=1)
    pairs = _top(inertia, weight, heyoka)
    integrator: Any = heyoka.taylor_adaptive(pairs, np.zeros(len(pairs), wide), tol=wide(rtol), fp_type=wide)
    ends = np.empty((len(q), 4))
    for row, at_end in zip(np.concatenate([q, Pi], axis=1), ends, strict=True):
        integrator.state[:] = row
        integrator.time = wide(0)
        integrator.propagate_until(wide(end))
        at_end[:] = integrator.state[:4] / np.sqrt((integrator.state[:4] ** 2).sum())
    return ends


def of_bodies(inertia: Sequence[float], weight: Sequence[float] = (0.0, 0.0, 0.0)) -> Callable[..., Contestant]:
    """(dt, rtol) ↦ heavy tops of this weight; free bodies without one."""
    return partial(many_systems, partial(_top, tuple(inertia), tuple(weight)), _load, _read)


def of_satellites(inertia: Sequence[float], orbit: Any, t0: float) -> Callable[..., Contestant]:
    """(dt, rtol) ↦ bodies under the gradient of gravity, from t0 on, on an orbit in the plane z = 0."""
    place, velocity = (np.asarray(x)[:2] for x in orbit(t0))

    def load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.concatenate([_load(q, p), np.tile([*place, *velocity], (len(q), 1))], axis=1)

    equations = partial(_satellite, tuple(inertia), float(orbit.mu))
    return partial(many_systems, equations, load, lambda rows: _read(rows[:, :7]))


def _load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.concatenate([q, to_body(q, p)], axis=1)


def _read(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q = rows[:, :4] / np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
    return q, to_space(q, rows[:, 4:])


def _top(inertia: Sequence[float], weight: Sequence[float], heyoka: Any) -> list[Any]:
    """Π̇ = Π × Ω + Γ × E with Γ the vertical in the body."""
    y = heyoka.make_vars("w", "x", "y", "z", "a", "b", "c")
    if not any(weight):
        return _turning(inertia, y, (0.0, 0.0, 0.0))
    w, x, y2, z = y[:4]
    Gamma = [2 * (x * z - w * y2), 2 * (y2 * z + w * x), 1 - 2 * (x * x + y2 * y2)]
    return _turning(inertia, y, cross(Gamma, weight))


def _satellite(inertia: Sequence[float], mu: float, heyoka: Any) -> list[Any]:
    """Π̇ = Π × Ω + (3μ/r⁵) Γ × JΓ with Γ the position (X, Y, 0) in the body, and Kepler's motion of it."""
    body = heyoka.make_vars("w", "x", "y", "z", "a", "b", "c")
    X, Y, U, V = heyoka.make_vars("X", "Y", "U", "V")
    w, x, y, z = body[:4]
    square = X * X + Y * Y
    k = 3.0 * mu * square**-2.5
    G1 = (1 - 2 * (y * y + z * z)) * X + 2 * (x * y + w * z) * Y
    G2 = 2 * (x * y - w * z) * X + (1 - 2 * (x * x + z * z)) * Y
    G3 = 2 * (x * z + w * y) * X + 2 * (y * z - w * x) * Y
    J1, J2, J3 = inertia
    torque = [(J3 - J2) * k * G2 * G3, (J1 - J3) * k * G3 * G1, (J2 - J1) * k * G1 * G2]
    pull = -mu * square**-1.5
    return [*_turning(inertia, body, torque), (X, U), (Y, V), (U, pull * X), (V, pull * Y)]


def _turning(inertia: Sequence[float], body: Sequence[Any], torque: Sequence[Any]) -> list[Any]:
    """q̇ = ½ q Ω, Π̇ = Π × Ω + torque."""
    w, x, y, z, *Pi = body
    u, v, s = Omega = [a / J for a, J in zip(Pi, inertia, strict=True)]
    q_dot = [-0.5 * (x * u + y * v + z * s), 0.5 * (w * u + y * s - z * v)]
    q_dot += [0.5 * (w * v + z * u - x * s), 0.5 * (w * s + x * v - y * u)]
    return list(zip(body, [*q_dot, *(a + b for a, b in zip(cross(Pi, Omega), torque, strict=True))], strict=True))


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def rotate(w: Any, v: Sequence[Any], u: Sequence[Any]) -> list[Any]:
    """u rotated by the quaternion (w, v)."""
    t = [2.0 * x for x in cross(v, u)]
    return [a + w * b + c for a, b, c in zip(u, t, cross(v, t), strict=True)]
