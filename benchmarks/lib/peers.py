"""Other packages as contestants: diffrax, MuJoCo, scipy, astrojax (heyoka: taylor.py). Each function imports its own.

Each package is used as its documentation recommends, in its fastest way. diffrax integrates our vector field
(quaternion and spatial momentum, so momentum is exact there too; 25 % faster than the same with jnp.cross), vmapped,
with dt0 = dt and constant steps; with time counted in steps, so that dt0 = 1, it runs 10 % faster. Adaptive, it takes
its PIDController with rtol = atol and finds its first step; a batch then takes as many steps as its worst body. MuJoCo
has contacts and constraints switched off, one thread, many states a call; its rollout keeps every state. 4.0's Batch
keeps the last alone, and runs at the same rate. scipy takes one body at a time, with Euler's equations in plain floats,
which is faster there than numpy. astrojax steps with a time that the bodies share, so that its position function is
called once for all. Its own composition of the torque and the motion of the quaternion is not used: in 0.8 the torque
reads a quaternion as the inverse of the rotation that the motion does, so that the two together are no satellite. Here
the torque gets the conjugate.
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
from lieint_jax.groups import so3
from lieint_jax.runs import compiler_options
from lieint_jax.systems import AbstractDrivenSystem

_PACES = {"Tsit5": 6e6, "Dopri8": 1.5e6}  # body-steps a second, about
_ROLLOUT = 100  # steps per call of MuJoCo's rollout, which keeps every state

_MODEL = """
<mujoco>
  <option timestep="{dt!r}" integrator="RK4" gravity="0 0 {down!r}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody>
    <body><joint type="ball"/><inertial pos="{center}" mass="1" fullinertia="{inertia}"/></body>
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
    return by_diffrax(name, solve, dt, dtype, rtol, _PACES[name])


tsit5 = partial(_diffrax, "Tsit5")  # of order 5
dopri8 = partial(_diffrax, "Dopri8")  # of order 8


def diffrax_of(
    name: str, system: Any, wide: bool = True, whole: bool = False, t0: float = 0.0
) -> Callable[..., Contestant]:
    """(dt, rtol=None) ↦ a solver of diffrax on the right-hand side of any system, vmapped or of the `whole` batch.

    Steps of dt; adaptive with an rtol. Compiled once for all of them. A driven system starts at t0; the members of a
    whole batch share their time and, adaptive, their steps.
    """
    solver = cache(lambda adaptive: compiled(name, system, adaptive, wide, whole, t0))

    def make(dt: float, rtol: float | None = None) -> Contestant:
        found = by_diffrax(name, solver(rtol is not None), dt, "float64", rtol, pace=1.5e6)
        title = found.name.replace("vmapped", "one solve of the batch") if whole else found.name
        return found._replace(name=title + ", wide vectors" * wide)

    return make


def by_diffrax(
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
    return compiled(name, body, adaptive, wide)


def compiled(
    name: str, system: Any, adaptive: bool, wide: bool, whole: bool = False, t0: float = 0.0
) -> Callable[..., li.State]:
    """(states, number of steps, dt, rtol) ↦ states, compiled once for all numbers."""
    import diffrax

    def rate(t: Any, z: li.State) -> li.State:
        if not isinstance(system, AbstractDrivenSystem):
            return system.vector_field(z)
        return system.vector_field(z._replace(t=t0 + t))._replace(work=None)

    solver: Any = getattr(diffrax, name)()
    field = jax.vmap(rate, (None, 0)) if whole else rate
    term = diffrax.ODETerm(lambda t, z, args: field(t, z))
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

        if whole:
            return jax.tree.map(lambda leaf: leaf[-1], one_body(states))
        return jax.tree.map(lambda leaf: leaf[:, -1], jax.vmap(one_body)(states))

    return solve


def mujoco_rk4(inertia: Sequence[float], dt: float, weight: Sequence[float] | None = None) -> Contestant:
    """MuJoCo's RK4 on a ball joint, through `mujoco.rollout` on one thread; a weight is 1 kg at weight/10, g = 10."""
    import mujoco
    from mujoco import rollout

    g = 10.0 if weight else 0.0
    c = np.asarray(weight or [0.0, 0.0, 0.0]) / 10
    about = np.diag(inertia) - (c @ c) * np.eye(3) + np.outer(c, c)  # about the center of mass (Steiner)
    six = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    numbers = {"inertia": " ".join(map(repr, six.tolist())), "center": " ".join(map(repr, c.tolist()))}
    xml = _MODEL.format(dt=dt, down=-g, **numbers)
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    J = np.asarray(inertia)

    def load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros((len(q), 1)), q, to_body(q, p) / J], axis=1)  # time, qpos, qvel

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        for done in range(0, num_steps, _ROLLOUT):
            count = min(_ROLLOUT, num_steps - done)
            trajectories, _ = rollout.rollout(model, data, states, nstep=count)
            states = np.asarray(trajectories)[:, -1]
        return states

    def read(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return states[:, 1:5], to_space(states[:, 1:5], J * states[:, 5:])

    return Contestant("MuJoCo RK4, rollout", "float64", 2.5e5, load, advance, read)


def dop853(inertia: Sequence[float], dt: float, rtol: float = 1e-10) -> Contestant:
    """scipy's DOP853, order 8, adaptive with rtol = atol, one body after the other; its "step" is a time dt."""
    from scipy.integrate import solve_ivp

    field = _euler(*inertia)

    def load(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.concatenate([q, to_body(q, p)], axis=1)

    def advance(states: np.ndarray, num_steps: int) -> np.ndarray:
        span = (0.0, num_steps * dt)
        ends = [solve_ivp(field, span, z, method="DOP853", rtol=rtol, atol=rtol).y[:, -1] for z in states]
        return np.stack(ends)

    def read(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = states[:, :4] / np.linalg.norm(states[:, :4], axis=1, keepdims=True)
        return q, to_space(q, states[:, 4:])

    return Contestant(f"scipy DOP853, rtol {rtol:g}", "float64", 1.5e5, load, advance, read)


def _euler(J1: float, J2: float, J3: float) -> Callable[[float, np.ndarray], list[float]]:
    """q̇ = ½ q Ω, Π̇ = Π × Ω for one body."""

    def field(_: float, state: np.ndarray) -> list[float]:
        w, x, y, z, a, b, c = state.tolist()
        u, v, t = a / J1, b / J2, c / J3
        q_dot = [-(x * u + y * v + z * t) / 2, (w * u + y * t - z * v) / 2, (w * v + z * u - x * t) / 2]
        return [*q_dot, (w * t + x * v - y * u) / 2, b * t - c * v, c * u - a * t, a * v - b * u]

    return field


def astrojax_of(inertia: Sequence[float], orbit: Any, dt: float, rtol: float | None = None) -> Contestant:
    """astrojax's gravity gradient on an orbit with μ = 1: RK4 with steps of dt, or DP54 with rtol = atol, from t = 0.

    RK4 at a time that all share; adaptive, a body has a time of its own, and a "step" is a time dt.
    """
    from astrojax import set_dtype
    from astrojax.attitude_dynamics.euler_dynamics import euler_equation, quaternion_derivative
    from astrojax.attitude_dynamics.gravity_gradient import torque_gravity_gradient
    from astrojax.integrators import AdaptiveConfig, dp54_step, rk4_step

    set_dtype(jnp.float64)  # pyright: ignore[reportArgumentType]
    diagonal = np.asarray(inertia)
    J, conjugate = np.diag(diagonal), np.array([1.0, -1.0, -1.0, -1.0])

    def field(t: Any, x: Any) -> jax.Array:
        torque = torque_gravity_gradient(conjugate * x[:4], orbit(t)[0], J, 1.0)
        return jnp.concatenate([quaternion_derivative(x[:4], x[4:]), euler_equation(x[4:], J, torque)])

    @partial(jax.jit, compiler_options=compiler_options())
    def constant(states: jax.Array, num_steps: jax.Array) -> jax.Array:
        def body(n: jax.Array, x: jax.Array) -> jax.Array:
            return jax.vmap(lambda x: rk4_step(field, n * dt, x, dt).state)(x)

        return jax.lax.fori_loop(0, num_steps, body, states)

    @partial(jax.jit, compiler_options=compiler_options())
    def adaptive(states: jax.Array, num_steps: jax.Array) -> jax.Array:
        end, tolerances = num_steps * dt, AdaptiveConfig(abs_tol=rtol, rel_tol=rtol)  # pyright: ignore[reportArgumentType]

        def step_once(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            t, h, x = carry
            made = dp54_step(field, t, x, jnp.minimum(h, end - t), tolerances)
            return t + made.dt_used, made.dt_next, made.state

        def solve(x: jax.Array) -> jax.Array:
            return jax.lax.while_loop(lambda carry: carry[0] < end, step_once, (0.0 * end, 0.0 * end + 0.01, x))[2]

        return jax.vmap(solve)(states)

    def load(q: np.ndarray, p: np.ndarray) -> jax.Array:
        return jnp.concatenate([jnp.asarray(q), jnp.asarray(to_body(q, p) / diagonal)], axis=1)

    def advance(states: jax.Array, num_steps: int) -> jax.Array:
        return jax.block_until_ready((constant if rtol is None else adaptive)(states, num_steps))

    def read(states: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        x = np.asarray(states)
        q = x[:, :4] / np.linalg.norm(x[:, :4], axis=1, keepdims=True)
        return q, to_space(q, diagonal * x[:, 4:])

    title = "astrojax RK4, vmapped" if rtol is None else "astrojax DP54, vmapped, adaptive"
    return Contestant(title, "float64", 1e6, load, advance, read)


def to_body(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(so3.Ad_star)(jnp.asarray(q), jnp.asarray(p)))


def to_space(q: np.ndarray, Pi: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(so3.Ad)(jnp.asarray(q), jnp.asarray(Pi)))
