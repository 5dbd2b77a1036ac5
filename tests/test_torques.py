"""Torques and internal friction: the exact balance of power and of momentum for every law and every κ."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import turned

from lieint_jax import torques
from lieint_jax.diagnostics.order import distance
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa, kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import damped_body, torqued_body

KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)
J = np.array([1.0, 2.0, 2.7])
FULL = turned(J)
D = np.array(turned([0.3, 0.1, 0.2]))
TARGET = np.array([0.8, 0.0, -0.6, 0.0])
ARM, NORMAL = np.array([0.3, -0.2, 0.9]), np.array([0.6, 0.0, 0.8])
OMEGA = np.array([0.5, -0.3, 0.6])


def one_of(which, x):
    """One of the three κ's: the coefficients are leaves, so all share a compilation."""
    return sum(w * kappa(x) for w, kappa in zip(which, KAPPAS, strict=True))


SHARED = Kappa(jax.tree_util.Partial(one_of, jnp.eye(3)), "shared")  # a batch of three
MEMBERS = dict(step=Kappa(jax.tree_util.Partial(one_of, 0), "shared"))


def field(t):
    return jnp.stack([jnp.sin(t), 0.4 * jnp.ones_like(t), jnp.cos(2 * t)])


def push(t, q, omega):
    """A torque of everything, with no meaning."""
    turn = jnp.stack([q[0] * q[1], q[2] * q[3], q[0] * q[3]])
    return jnp.sin(3 * t) * jnp.array([0.2, -0.1, 0.3]) + turn - 0.1 * jnp.cross(omega, turn) - 0.05 * omega**3


LAWS = {
    "push in space": (push, "space"),
    "push in the body": (push, "body"),
    "viscous": (torques.viscous(D), None),
    "pd_trace": (torques.pd_trace(0.7, 0.2, TARGET), None),
    "pd_quaternion": (torques.pd_quaternion(0.7, 0.2, TARGET), None),
    "bdot": (torques.bdot(0.2, field), None),
    "kane_damper": (torques.kane_damper(0.4, 0.3), None),
    "thruster": (torques.thruster([0.3, -0.5, 0.2], 0.33, 1.77), None),
    "solar_plate": (torques.solar_plate(0.4, NORMAL, ARM, [0.0, 0.6, 0.8], 0.6, 0.3), None),
}
BODIES = {name: torqued_body(FULL, torque, frame) for name, (torque, frame) in LAWS.items()}
BODIES["internal friction"] = damped_body(FULL, 0.3)


def vex(B):
    return jnp.stack([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])


def expected(name, a, b, dt):
    """The mean torque in space and the power of a step from a to b, by the formulas, in matrices."""
    t, La, Lb = a.t + dt / 2, so3.to_matrix(a.q), so3.to_matrix(b.q)
    L, Pi = (La + Lb) / 2, (La.T @ a.p + Lb.T @ b.p) / 2
    Omega = jnp.linalg.solve(FULL, Pi)
    omega, half = La @ Omega, (a.q + b.q) / jnp.linalg.norm(a.q + b.q)
    turn = so3.multiply(so3.inverse(a.q), b.q)
    h = turn[1:] / turn[0]
    kappa = jnp.sqrt(h @ h / (Omega @ Omega)) / jnp.abs(dt / 2)
    if name == "push in space":
        torque = push(t, half, omega)
        return torque, omega @ torque
    if name == "push in the body":
        torque = push(t, half, Omega)
        return L @ torque, Omega @ torque
    if name == "viscous":
        return -L @ D @ Omega, -Omega @ D @ Omega
    if name == "pd_trace":
        return -0.35 * kappa * vex(L @ so3.to_matrix(TARGET).T) - 0.2 * omega, -0.2 * omega @ omega
    if name == "pd_quaternion":
        v = sum(so3.multiply(so3.inverse(TARGET), q)[1:] for q in (a.q, b.q))
        torque = -kappa * 0.7 * v / (1 + jnp.sqrt(1 + h @ h)) - 0.2 * Omega
        return L @ torque, -0.2 * Omega @ Omega
    if name == "bdot":
        f = field(t)
        return -0.2 * (f @ f * omega - f * (f @ omega)), -0.2 * jnp.sum(jnp.cross(f, omega) ** 2)
    if name == "kane_damper":
        slip = omega - (a.extra["damper"] + b.extra["damper"]) / 2 / 0.4
        return -0.3 * slip, -0.3 * slip @ slip
    if name == "thruster":
        low, high = jnp.minimum(a.t, b.t), jnp.maximum(a.t, b.t)
        part = jnp.maximum(jnp.minimum(high, 1.77) - jnp.maximum(low, 0.33), 0) / jnp.abs(dt)
        torque = part * jnp.array([0.3, -0.5, 0.2])
        return L @ torque, Omega @ torque
    if name == "solar_plate":
        s = so3.to_matrix(half).T @ np.array([0.0, 0.6, 0.8])
        c = NORMAL @ s
        side = jnp.sign(c) * NORMAL
        force = -0.4 * jnp.abs(c) * (0.4 * s + 2 * (0.6 * jnp.abs(c) + 0.1) * side)
        torque = jnp.cross(ARM, force)
        return L @ torque, Omega @ torque
    slip = jnp.cross(Pi, Omega)
    wide = Omega + 0.3 * slip
    kappa = jnp.sqrt(h @ h / (wide @ wide)) / jnp.abs(dt / 2)
    return jnp.zeros(3), -0.3 * kappa * slip @ slip


@functools.partial(jax.jit, static_argnums=0)
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
def balance(name, row, q, Omega, dt):
    """Errors of the balances of each step, of 24 steps there and 24 back."""
    body = BODIES[name]
    step = torqued_midpoint(body, Kappa(jax.tree_util.Partial(one_of, row), "shared"))
    start = body.state(q, angular_velocity=Omega, t=0.2, work=0.0)
    if name == "kane_damper":
        start = start._replace(extra={"damper": jnp.array([0.1, -0.3, 0.2])})
    sizes = jnp.where(jnp.arange(48) < 24, dt, -dt)
    end, (before, after, info) = jax.lax.scan(lambda z, h: ((n := step(z, h))[0], (z, *n)), start, sizes)
    torque, power = jax.vmap(functools.partial(expected, name))(before, after, sizes)
    (H, H_), (P, P_) = ([jax.vmap(f)(z) for z in (before, after)] for f in (body.energy, body.momentum))
    H_scale, size = jnp.abs(H).max(), jnp.abs(before.p).max()
    return {
        "converged": info.converged.all(),
        "energy": jnp.abs(H_ - H - sizes * power).max() / H_scale,
        "work": jnp.abs(after.work - before.work - sizes * power).max() / H_scale,
        "sum": jnp.abs(H_ - after.work - H[0]).max() / H_scale,
        "impulse": jnp.abs(after.p - before.p - sizes[:, None] * torque).max() / size,
        "momentum": jnp.abs(P_ - P[0]).max(initial=0) / size,
        "norm": jnp.abs(jax.vmap(so3.defect)(after.q)).max(),
        "back": distance(end, start),
        "changed": jnp.abs(H - H[0]).max() / H[0],
    }


def random_cases(B):
    rng = np.random.default_rng(0)
    q, dt = rng.normal(size=(B, 4)), rng.choice([-1, 1], B) * rng.uniform(0.02, 0.1, B)
    return (
        np.repeat(np.eye(3), B // 3, axis=0),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        rng.normal(size=(B, 3)),
        dt,
    )


BOUNDS = {  # a few times what was seen
    "energy": 5e-15,  # 2e-15
    "work": 1e-15,  # 2e-16
    "sum": 1e-14,  # 3e-15
    "impulse": 1e-15,  # 2e-16
    "momentum": 5e-15,
    "norm": 2e-15,  # 4e-16
    "back": 5e-15,
}


@pytest.mark.parametrize("name", BODIES)
def test_energy_changes_by_the_work_and_momentum_by_the_impulse(name):
    """Each κ, 16 bodies each, Δt of both signs; by the formulas of each law in matrices."""
    found = jax.device_get(balance(name, *random_cases(48)))
    print(name, {k: float(np.max(v)) for k, v in found.items()}, found["converged"].sum(), np.median(found["changed"]))
    assert found["converged"].all()
    assert np.median(found["changed"]) > 1e-3
    for key, bound in BOUNDS.items():
        assert found[key].max() < bound, key
