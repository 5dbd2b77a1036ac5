"""The motion of one body in its own axes: q̇ = ½ q Ω, Π̇ = Π × Ω + Γ × ∇Ṽ(Γ), component by component.

What is explicit and of high order takes these unknowns: half the operations of (q, π), and at equal steps a fiftieth of
the error on tops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import kernel, three
from lieint_jax._numerics.three import add, apply, cross, dot, scale, subtract
from lieint_jax.groups import so3
from lieint_jax.schemes._capability import other_motion
from lieint_jax.types import DrivenTop, FreeBody, Gyrostat, State, System, Top


class Turning(NamedTuple):
    """The unknowns: a quaternion, body momentum, and the time and work of a state that has them."""

    q: tuple[Array, ...]
    Pi: tuple[Array, ...]
    t: Array | None
    work: Array | None


def known(system: System) -> bool:
    """Whether a system is one body with at most a potential that has an axis, and moves as that says."""
    if isinstance(system, Top | DrivenTop) and system.axis is None:
        return False
    return isinstance(system, Top | DrivenTop | FreeBody | Gyrostat) and not other_motion(motion, system, system)


def unknowns(state: State) -> Turning:
    Pi = so3.Ad_star(state.q, state.p)
    return Turning(three.components(state.q), three.components(Pi), state.t, state.work)


def moved(state: State, z: Turning, delta: Turning) -> State:
    """The state whose unknowns are z, after their increments. π moves by an increment as well, for the last digits."""
    q, dq = z.q, delta.q
    excess = so3.defect(state.q) + sum(d * (2 * x + d) for x, d in zip(q, dq, strict=True))  # |q|² − 1 of the end
    s = jnp.sqrt(1 + excess)
    r = -excess / (s * (1 + s))  # 1/s − 1
    dw, *du = (d + r * (x + d) for x, d in zip(q, dq, strict=True))
    (w, *u), Pi = q, add(z.Pi, delta.Pi)
    end = add(u, du)
    across = add(scale(dw, cross(end, Pi)), scale(w, cross(du, Pi)))
    turned = scale(2, add(across, add(cross(du, cross(end, Pi)), cross(u, cross(du, Pi)))))  # by q + dq less by q
    p = state.p + jnp.stack(add(so3.Ad(state.q, jnp.stack(delta.Pi)), turned))
    work = None if state.work is None or delta.work is None else state.work + delta.work
    return state._replace(q=state.q + jnp.stack([dw, *du]), p=p, work=work)


def rate(system: Any) -> Callable[[Any], Turning]:
    """The time derivative of the unknowns, for |q| = 1 but for the error of a step."""
    inverse = three.inverse(system.inertia)

    def of(z: Any) -> Turning:
        q, Pi = z.q, z.Pi
        Omega = apply(inverse, subtract(Pi, system.rotor) if isinstance(system, Gyrostat) else Pi)
        torque = cross(Pi, Omega)
        if isinstance(system, Top | DrivenTop):
            torque = add(torque, _torque(system, z))
        t = None if z.t is None else jnp.ones_like(z.t)
        work = None if z.work is None else _power(system, z)
        return Turning(by(q, scale(0.5, Omega)), torque, t, work)

    return of


def motion(system: Any, state: State) -> State:
    """The time derivative of q and p that follows from that of the unknowns."""
    z = unknowns(state)
    q_dot = jnp.stack(rate(system)(z).q)
    if not isinstance(system, Top | DrivenTop):
        return State(q_dot, jnp.zeros_like(state.p))
    return State(q_dot, so3.Ad(state.q, jnp.stack(_torque(system, z))))


def _power(system: Any, z: Any) -> Array:
    return system.power(so3.normalise(jnp.stack(z.q)), z.t) if isinstance(system, DrivenTop) else jnp.zeros_like(z.work)


def _torque(system: Any, z: Any) -> tuple[Array, ...]:
    """Γ × ∇Ṽ(Γ), with Γ = Λᵀγ."""
    driven = isinstance(system, DrivenTop)
    axis, more = (system.axis_at(z.t), (z.t,)) if driven else (system.axis, ())
    Gamma = _axis_in_body(z.q, axis)
    return cross(Gamma, jax.grad(system.potential)(jnp.stack(Gamma), *more))


def seen(q: tuple[Array, ...], axis: three.Vector) -> tuple[Array, Array, Array]:
    """|q|² Λᵀγ, the axis γ as the body sees it: Im(q̄γq)."""
    w, *v = q
    return add(scale(w * w - dot(v, v), axis), add(scale(2 * dot(v, axis), v), scale(2 * w, cross(axis, v))))


@kernel.stage
def _axis_in_body(q: tuple[Array, ...], axis: three.Vector) -> tuple[Array, Array, Array]:
    """Λᵀγ for |q| = 1, in fewer operations than `seen`."""
    w, *v = q
    u = scale(2, cross(axis, v))
    return add(axis, subtract(scale(w, u), cross(v, u)))


def by(q: tuple[Array, ...], u: three.Vector) -> tuple[Array, Array, Array, Array]:
    """q(0, u)."""
    w, *v = q
    return (-dot(v, u), *add(scale(w, u), cross(v, u)))
