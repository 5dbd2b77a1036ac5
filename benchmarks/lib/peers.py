"""Other packages as contestants: diffrax, MuJoCo, scipy. Each function imports its package and makes a contestant.

Each package is used as its documentation recommends, in its fastest way. diffrax integrates our vector field
(quaternion and spatial momentum, so momentum is exact there too; 25 % faster than the same with jnp.cross), vmapped,
with dt0 = dt and constant steps; with time counted in steps, so that dt0 = 1, it runs 10 % faster. Adaptive, it takes
its PIDController with rtol = atol and finds its first step; a batch then takes as many steps as its worst body. MuJoCo
has contacts and constraints switched off, one thread, many states a call; its rollout keeps every state. scipy takes
one body at a time, with Euler's equations in plain floats, which is faster there than numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib.contest import Contestant

import lieint_jax as li
from lieint_jax.ensemble import compiler_options
from lieint_jax.groups import so3

_PACES = {"Tsit5": 6e6, "Dopri8": 1.5e6}  # body-steps a second, about
_ROLLOUT = 100  # steps per call of MuJoCo's rollout, which keeps every state

_MODEL = """
<mujoco>
  <option timestep="{dt!r}" integrator="RK4" gravity="0 0 {down!r}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody>
    <body><joint type="ball"/><inertial pos="{centre}" mass="1" fullinertia="{inertia}"/></body>
  </worldbody>
</mujoco>
"""


def _diffrax(
    name: str,
    inertia: Sequence[float],
    dt: float,
    dtype: str = "float64",
    rtol: float | None = None,
    wide: bool = False,
    weight: Sequence[float] | None = None,
) -> Contestant:
    """A solver of diffrax, vmapped, steps of dt; with rtol = atol given, adaptive, and its "step" is a time dt.

    With a `weight` it integrates heavy tops; so do the other contestants that take one.
    """
    solve = _solver(name, tuple(inertia), weight and tuple(weight), dtype, rtol is not None, wide)
    return _contestant(name, solve, dt, dtype, rtol, _PACES[name])


tsit5 = partial(_diffrax, "Tsit5")  # of order 5
dopri8 = partial(_diffrax, "Dopri8")  # of order 8


def tsit5_of(system: Any, dt: float, wide: bool = False) -> Contestant:
    """diffrax's Tsit5 on the right-hand side of any system, vmapped, steps of dt, float64."""
    name = "Tsit5"
    found = _contestant(name, _compiled(name, system, False, wide), dt, "float64", None, pace=1.5e6)
    return found._replace(name=found.name + ", wide vectors" * wide)


def _contestant(
    name: str, solve: Callable[..., li.State], dt: float, dtype: str, rtol: float | None, pace: float
) -> Contestant:
    h, tolerance = (np.asarray(x, dtype) for x in (dt, rtol or 0.0))

    def load(q: np.ndarray, p: np.ndarray) -> li.State:
        return li.State(jnp.asarray(q, dtype), jnp.asarray(p, dtype))

    def advance(states: li.State, num_steps: int) -> li.State:
        return jax.block_until_ready(solve(states, np.asarray(num_steps, dtype), h, tolerance))

    def read(states: li.State) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(states.q), np.asarray(states.p)

    title = f"diffrax {name}, vmapped" + (", adaptive" if rtol is not None else "")
    return Contestant(title, dtype, pace, load, advance, read)


@cache
def _solver(
    name: str, inertia: tuple[float, ...], weight: tuple[float, ...] | None, dtype: str, adaptive: bool, wide: bool
) -> Callable[..., li.State]:
    J = np.asarray(inertia, dtype)
    body = li.systems.heavy_top(J, np.asarray(weight, dtype)) if weight else li.systems.rigid_body(J)
    return _compiled(name, body, adaptive, wide)


def _compiled(name: str, system: Any, adaptive: bool, wide: bool) -> Callable[..., li.State]:
    """(states, number of steps, dt, rtol) ↦ states, compiled once for all numbers."""
    import diffrax

    solver: Any = getattr(diffrax, name)()
    term = diffrax.ODETerm(lambda t, z, args: system.vector_field(z))
    zero = np.zeros((), jax.tree.leaves(system)[0].dtype)

    @partial(jax.jit, compiler_options=compiler_options() if wide else {})
    def solve(states: li.State, num_steps: jax.Array, h: jax.Array, rtol: jax.Array) -> li.State:
        controller = diffrax.PIDController(rtol, rtol) if adaptive else diffrax.ConstantStepSize()
        first = None if adaptive else h

        def one_body(z: li.State) -> Any:
            end = num_steps * h
            return diffrax.diffeqsolve(
                term, solver, zero, end, first, z, stepsize_controller=controller, max_steps=None
            ).ys

        return jax.tree.map(lambda leaf: leaf[:, -1], jax.vmap(one_body)(states))

    return solve


def mujoco_rk4(inertia: Sequence[float], dt: float, weight: Sequence[float] | None = None) -> Contestant:
    """MuJoCo's RK4 on a ball joint, through `mujoco.rollout` on one thread; a weight is 1 kg at weight/10, g = 10."""
    import mujoco
    from mujoco import rollout

    g = 10.0 if weight else 0.0
    c = np.asarray(weight or [0.0, 0.0, 0.0]) / 10
    about = np.diag(inertia) - (c @ c) * np.eye(3) + np.outer(c, c)  # about the centre of mass (Steiner)
    six = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    numbers = {"inertia": " ".join(map(repr, six.tolist())), "centre": " ".join(map(repr, c.tolist()))}
    xml = _MODEL.format(dt=dt, down=-g, **numbers)
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    J = np.asarray(inertia)

    def load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros((len(q), 1)), q, _to_body(q, p) / J], axis=1)  # time, qpos, qvel

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        for done in range(0, num_steps, _ROLLOUT):
            count = min(_ROLLOUT, num_steps - done)
            trajectories, _ = rollout.rollout(model, data, states, nstep=count)
            states = np.asarray(trajectories)[:, -1]
        return states

    def read(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return states[:, 1:5], _to_space(states[:, 1:5], J * states[:, 5:])

    return Contestant("MuJoCo RK4, rollout", "float64", 2.5e5, load, advance, read)


def dop853(inertia: Sequence[float], dt: float, rtol: float = 1e-10) -> Contestant:
    """scipy's DOP853, order 8, adaptive with rtol = atol, one body after the other; its "step" is a time dt."""
    from scipy.integrate import solve_ivp

    field = _euler(*inertia)

    def load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.concatenate([q, _to_body(q, p)], axis=1)

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        span = (0.0, num_steps * dt)
        ends = [solve_ivp(field, span, z, method="DOP853", rtol=rtol, atol=rtol).y[:, -1] for z in states]
        return np.stack(ends)

    def read(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = states[:, :4] / np.linalg.norm(states[:, :4], axis=1, keepdims=True)
        return q, _to_space(q, states[:, 4:])

    return Contestant(f"scipy DOP853, rtol {rtol:g}", "float64", 1.5e5, load, advance, read)


def _euler(J1: float, J2: float, J3: float) -> Callable[[float, np.ndarray], list[float]]:
    """q̇ = ½ q Ω, Π̇ = Π × Ω for one body."""

    def field(_: float, state: np.ndarray) -> list[float]:
        w, x, y, z, a, b, c = state.tolist()
        u, v, t = a / J1, b / J2, c / J3
        q_dot = [-(x * u + y * v + z * t) / 2, (w * u + y * t - z * v) / 2, (w * v + z * u - x * t) / 2]
        return [*q_dot, (w * t + x * v - y * u) / 2, b * t - c * v, c * u - a * t, a * v - b * u]

    return field


def _to_body(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(so3.Ad_star)(jnp.asarray(q), jnp.asarray(p)))


def _to_space(q: np.ndarray, Pi: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(so3.Ad)(jnp.asarray(q), jnp.asarray(Pi)))
