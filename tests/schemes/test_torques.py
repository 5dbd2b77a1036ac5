"""Torques and internal friction: the exact balance of power and of momentum for every law and every κ."""

import functools
from unittest import mock

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import slopes
from free_bodies import Q, moving, rows, turned
from kappas import chosen
from repeated import after
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import State, _discover, schemes, torques
from lieint_jax._numerics.vectors import Vector
from lieint_jax.core import StepInfo
from lieint_jax.core.tangent import distance
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_exponential
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import damped_body, torqued_body

pytestmark = pytest.mark.long

EQUATION = _discover.modules_with("examples", schemes)["torqued_midpoint"].TorqueEquation

J = np.array([1.0, 2.0, 2.7])
FULL = turned(J)
D = np.array(turned([0.3, 0.1, 0.2]))
TARGET = np.array([0.8, 0.0, -0.6, 0.0])
PRINCIPAL = np.array(rows(*Q))  # Λᵀ of Q: its rows are the axes of the body in space
ARM, NORMAL = np.array([0.3, -0.2, 0.9]), np.array([0.6, 0.0, 0.8])
SUN = np.array([0.0, 0.6, 0.8])
OMEGA = np.array([0.5, -0.3, 0.6])


def field(t):
    return jnp.stack([jnp.sin(t), 0.4 * jnp.ones_like(t), jnp.cos(2 * t)])


def push(t, q, omega):
    """A torque of everything, with no meaning."""
    turn = jnp.stack([q[0] * q[1], q[2] * q[3], q[0] * q[3]])
    return jnp.sin(3 * t) * jnp.array([0.2, -0.1, 0.3]) + turn - 0.1 * jnp.cross(omega, turn) - 0.05 * omega**3


@li.pytree
class WithoutWork(torques.Law):
    """A law with an energy, whose work is that of its torque."""

    law: torques.PDTrace

    frame = "space"

    def mean(self, rotation, inner):
        return self.law.mean(rotation, inner)

    def energy(self, t, q, inner):
        return self.law.energy(t, q, inner)


LAWS = {
    "push in space": (push, "space"),
    "push in the body": (push, "body"),
    "viscous": (torques.viscous(D), None),
    "pd_trace": (torques.pd_trace(0.7, 0.2, TARGET), None),
    "pd_trace without its work": (WithoutWork(torques.pd_trace(0.7, 0.2, TARGET)), None),
    "pd_quaternion": (torques.pd_quaternion(0.7, 0.2, TARGET), None),
    "bdot": (torques.bdot(0.2, field), None),
    "kane_damper": (torques.kane_damper(0.4, 0.3), None),
    "thruster": (torques.thruster([0.3, -0.5, 0.2], 0.33, 1.77), None),
    "solar_plate": (torques.solar_plate(0.4, NORMAL, ARM, SUN, specular=0.6, diffuse=0.3), None),
}
BODIES = {name: torqued_body(FULL, torque, frame) for name, (torque, frame) in LAWS.items()}
BODIES["internal friction"] = damped_body(FULL, 0.3)


def vex(B):
    return jnp.stack([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])


def of_law(name, t, q, omega):
    """The torque in the axes of its law, by the formulas, in matrices."""
    if name.startswith("push"):
        return push(t, q, omega)
    if name == "viscous":
        return -D @ omega
    if name.startswith("pd_trace"):
        return -0.35 * vex(so3.to_matrix(q) @ so3.to_matrix(TARGET).T) - 0.2 * omega
    if name == "pd_quaternion":
        return -0.7 * so3.multiply(so3.inverse(TARGET), q)[1:] - 0.2 * omega
    if name == "bdot":
        f = field(t)
        return -0.2 * (f @ f * omega - f * (f @ omega))
    if name == "solar_plate":
        s = so3.to_matrix(q).T @ SUN
        c = NORMAL @ s
        lit, side = 0.4 * jnp.abs(c), jnp.sign(c) * NORMAL  # the side that faces the Sun
        absorbed = -lit * (1 - 0.6 - 0.3) * s
        mirrored = -lit * 0.6 * 2 * jnp.abs(c) * side
        scattered = -lit * 0.3 * (s + 2 / 3 * side)
        return jnp.cross(ARM, absorbed + mirrored + scattered)
    raise KeyError(name)


def expected(name, a, b, dt):
    """The mean torque in space and the power of a step from a to b, by the formulas, in matrices."""
    t, La, Lb = a.t + dt / 2, so3.to_matrix(a.q), so3.to_matrix(b.q)
    L, Pi = (La + Lb) / 2, (La.T @ a.p + Lb.T @ b.p) / 2
    Omega = jnp.linalg.solve(FULL, Pi)
    omega, half = La @ Omega, (a.q + b.q) / jnp.linalg.norm(a.q + b.q)
    turn = so3.multiply(so3.inverse(a.q), b.q)
    h = turn[1:] / turn[0]
    kappa = jnp.sqrt(h @ h / (Omega @ Omega)) / jnp.abs(dt / 2)
    if name.startswith("pd_trace"):
        return -0.35 * kappa * vex(L @ so3.to_matrix(TARGET).T) - 0.2 * omega, -0.2 * omega @ omega
    if name == "pd_quaternion":
        v = sum(so3.multiply(so3.inverse(TARGET), q)[1:] for q in (a.q, b.q))
        torque = -kappa * 0.7 * v / (1 + jnp.sqrt(1 + h @ h)) - 0.2 * Omega
        return L @ torque, -0.2 * Omega @ Omega
    if name == "kane_damper":
        slip = omega - (a.extra["damper"] + b.extra["damper"]) / 2 / 0.4
        return -0.3 * slip, -0.3 * slip @ slip
    if name == "thruster":
        low, high = jnp.minimum(a.t, b.t), jnp.maximum(a.t, b.t)
        part = jnp.maximum(jnp.minimum(high, 1.77) - jnp.maximum(low, 0.33), 0) / jnp.abs(dt)
        torque = part * jnp.array([0.3, -0.5, 0.2])
        return L @ torque, Omega @ torque
    if name == "internal friction":
        slip = jnp.cross(Pi, Omega)
        wide = Omega + 0.3 * slip
        kappa = jnp.sqrt(h @ h / (wide @ wide)) / jnp.abs(dt / 2)
        return jnp.zeros(3), -0.3 * kappa * slip @ slip
    if BODIES[name].frame == "space":
        torque = of_law(name, t, half, omega)
        return torque, omega @ torque
    torque = of_law(name, t, half, Omega)
    return L @ torque, Omega @ torque


@functools.partial(jax.jit, static_argnums=0)
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
def balance(name, row, q, Omega, dt):
    """Errors of the balances of 48 steps: there, back, and there again."""
    body = BODIES[name]
    step = torqued_midpoint(body, chosen(row))
    start = body.state(q, angular_velocity=Omega, t=0.2, work=0.0)
    if name == "kane_damper":
        start = start._replace(extra={"damper": jnp.array([0.1, -0.3, 0.2])})
    sizes = dt * jnp.tile(jnp.array([1, -1, 1]), 16)
    _, (before, after, info) = jax.lax.scan(lambda z, h: ((n := step(z, h))[0], (z, *n)), start, sizes)
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
        "back": jax.vmap(distance)(
            jax.tree.map(lambda x: x[2::3], before), jax.tree.map(lambda x: x[::3], before)
        ).max(),
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
    "momentum": 3e-15,  # 6e-16, of the body with its damper
    "norm": 2e-15,  # 4e-16
    "back": 2e-15,  # 4e-16
}


@pytest.mark.parametrize("name", BODIES)
def test_energy_changes_by_the_work_and_momentum_by_the_impulse(name):
    """Each κ, 16 bodies each, Δt of both signs; by the formulas of each law in matrices."""
    found = jax.device_get(balance(name, *random_cases(48)))
    assert found["converged"].all()
    assert np.median(found["changed"]) > 1e-3
    for key, bound in BOUNDS.items():
        assert found[key].max() < bound, key


@functools.partial(jax.jit, static_argnums=0)
def at_root(name, q, y, dt):
    """A step whose equation has the root y: the momentum before it follows from y, so nothing is solved.

    The states before and after it, and by how much the energy and the momentum change.
    """
    body, rest = BODIES[name], State(q, jnp.zeros(3), jnp.array(0.4), jnp.array(0.0))
    step = torqued_midpoint(body, kappa_exponential)
    if name == "kane_damper":
        rest = rest._replace(extra={"damper": jnp.array([0.1, -0.3, 0.2])})
    a = jnp.stack(EQUATION.from_state(step.kappa, step.system, rest, dt).residual(y))  # ½ΔtΠ/tr J
    start = rest._replace(p=so3.Ad(q, 2 / dt * jnp.trace(FULL) * a))
    with mock.patch.object(EQUATION, "solve", return_value=(Vector(y), StepInfo.empty(y))):
        end, _ = step(start, dt)
    return start, end, *(f(end) - f(start) for f in (body.energy, body.momentum))


@pytest.mark.quick
@pytest.mark.parametrize("name", [name for name in LAWS if name != "push in space"])
def test_every_law_balances_energy_and_momentum_at_a_given_root(name):
    """By the formulas of each law in matrices; a push in space see above, internal friction below."""
    for dt in (0.07, -0.05):
        start, end, gain, moved = at_root(name, Q, dt / 2 * OMEGA, dt)
        torque, power = expected(name, start, end, dt)
        size = np.abs(start.p).max()
        assert float(gain) == pytest.approx(float(dt * power), abs=5e-15)  # observed 4e-16
        assert float(end.work) == pytest.approx(float(dt * power), abs=1e-15)
        np.testing.assert_allclose(end.p - start.p, dt * torque, rtol=0, atol=1e-15 * size)
        np.testing.assert_allclose(moved, 0, rtol=0, atol=3e-15 * size)  # of the body and its damper
        assert abs(power) > 1e-3


@pytest.mark.quick
def test_the_rate_of_the_work_is_that_of_the_energy():
    """Along the vector field, for a law with and without a potential, a power, and a momentum of its own."""
    names = ["viscous", "pd_trace without its work", "kane_damper", "internal friction"]

    @jax.jit
    def both(q, p):
        found = {}
        for name in names:
            body, state = BODIES[name], State(q, p, jnp.array(0.4), jnp.array(0.0))
            if name == "kane_damper":
                state = state._replace(extra={"damper": jnp.array([0.1, -0.3, 0.2])})
            rate = body.vector_field(state)
            moving = rate._replace(t=jnp.ones(()), work=jnp.zeros(()))
            found[name] = jax.jvp(body.energy, (state,), (moving,))[1], rate.work
        return found

    for name, (energy, work) in both(Q, FULL @ OMEGA).items():
        assert float(energy) == pytest.approx(float(work), rel=1e-13, abs=0), name
        assert abs(work) > 1e-3, name


@pytest.mark.quick
def test_every_law_agrees_with_its_formula():
    """At one time, whatever the scheme makes of it: the laws against matrices, at random attitudes and velocities."""
    rng = np.random.default_rng(1)
    q, omega, t = rng.normal(size=(20, 4)), rng.normal(size=(20, 3)), rng.uniform(0, 3, 20)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    names = ["viscous", "pd_trace", "pd_quaternion", "bdot", "solar_plate"]

    @jax.jit
    @jax.vmap
    def both(t, q, omega):
        return [(LAWS[name][0](t, q, omega), of_law(name, t, q, omega)) for name in names]

    for own, formula in both(t, q, omega):
        np.testing.assert_allclose(own, formula, rtol=0, atol=2e-15)  # 4e-16
    thruster, friction = LAWS["thruster"][0], 0.3 * np.cross(omega, q[:, 1:])
    fires = jax.vmap(thruster)(t, q, omega)
    np.testing.assert_array_equal(fires, np.where(((t >= 0.33) & (t < 1.77))[:, None], thruster.torque, 0))
    np.testing.assert_allclose(
        np.stack(torques.internal_friction(0.3, omega.T, q[:, 1:].T)), friction.T, rtol=0, atol=1e-15
    )
    now = torques.Rotation(0.0, 0.0, Q, Q, Q, np.zeros(3), 1.0, OMEGA, OMEGA)
    torque, after = LAWS["kane_damper"][0].mean(now, jnp.array([0.1, -0.3, 0.2]))
    np.testing.assert_allclose(torque, -0.3 * (OMEGA - np.array([0.1, -0.3, 0.2]) / 0.4), rtol=1e-15, atol=0)
    np.testing.assert_array_equal(after, [0.1, -0.3, 0.2])


@functools.partial(jax.jit, static_argnums=3)
def path(step, state, dt, num_steps):
    """The states of a run, their energies, and whether all steps converged."""
    run = li.integrate(step, state, dt, num_steps)
    return run.state, jax.vmap(step.system.energy)(run.state), run.info.converged.all()


def last(states):
    return jax.tree.map(lambda x: np.asarray(x[-1]), states)


@pytest.mark.quick
def test_internal_friction_ends_about_the_major_axis_with_the_momentum_bit_for_bit():
    """As Explorer 1 did: from the minor axis to |π|²/2J₃."""
    body = damped_body(J, 0.4)
    start = body.state(Q, angular_velocity=[1.0, 0.05, -0.1], work=0.0)
    states, energy, converged = path(torqued_midpoint(body, kappa_exponential), start, 0.2, 2000)
    assert converged
    assert (states.p == start.p).all()
    assert np.diff(energy).max() < 4e-16 * energy[0]  # 1e-16
    np.testing.assert_allclose(energy - states.work, energy[0], rtol=0, atol=1e-13 * energy[0])
    assert energy[-1] == pytest.approx(float(start.p @ start.p) / 2 / J[2], rel=2e-14, abs=0)  # 2e-15
    Pi = body.body_momentum(last(states))
    np.testing.assert_allclose(Pi[:2], 0, rtol=0, atol=1e-12)


def test_a_damper_conserves_the_total_momentum_and_ends_about_the_major_axis():
    damper = torqued_body(J, torques.kane_damper(0.4, 0.3))
    start = damper.state(Q, angular_velocity=[1.0, 0.05, -0.1], work=0.0)
    states, energy, converged = path(torqued_midpoint(damper), start, 0.2, 6000)
    total = np.asarray(start.p + start.extra["damper"])
    size = np.linalg.norm(total)
    assert converged
    np.testing.assert_allclose(states.p + states.extra["damper"], np.tile(total, (6001, 1)), rtol=0, atol=4e-14 * size)
    assert np.diff(energy).max() < 4e-16 * energy[0]
    assert energy[0] > 1.5 * energy[-1]
    assert energy[-1] == pytest.approx(size**2 / 2 / (J[2] + 0.4), rel=1e-12, abs=0)
    end = last(states)
    np.testing.assert_allclose(damper.angular_velocity(end)[:2], 0, rtol=0, atol=1e-7)
    omega = so3.Ad(end.q, damper.angular_velocity(end))
    np.testing.assert_allclose(end.extra["damper"], 0.4 * omega, rtol=0, atol=1e-7)  # the sphere turns with the body


def turned_by(states):
    """The angle of a path of attitudes, from step to step."""
    q = np.asarray(states.q)
    return 2 * np.arccos(np.minimum(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 1)).sum()


def test_one_controller_unwinds_and_the_other_rotates_the_short_way():
    """From an error of 330°, that is of −30°, at rest about a principal axis: more damped than critically."""
    angle = np.deg2rad(330)
    for law, way in ((torques.pd_quaternion(0.5, 3.0), angle), (torques.pd_trace(0.5, 3.0), 2 * np.pi - angle)):
        body = torqued_body(J, law)
        start = body.state([np.cos(angle / 2), 0, 0, np.sin(angle / 2)], angular_velocity=np.zeros(3), work=0.0)
        states, energy, converged = path(torqued_midpoint(body), start, 0.1, 3000)
        assert converged
        assert turned_by(states) == pytest.approx(way, rel=1e-6)
        assert energy[-1] < 1e-6 * energy[0]
        assert np.diff(energy).max() < 4e-16 * energy[0]
        assert abs(last(states).q[0]) == pytest.approx(1, abs=1e-7)


def test_a_magnetic_field_that_rests_damps_all_but_the_turn_about_it():
    B = np.array([0.0, 0.6, 0.8])
    for b, left in ((B, True), (field, False)):
        body = torqued_body(J, torques.bdot(0.3, b))
        start = body.state(Q, angular_velocity=OMEGA, work=0.0)
        states, energy, converged = path(torqued_midpoint(body), start, 0.1, 3000)
        assert converged
        # the energy of a body that spins on has a rounding error of its own, 1.4e-15; 1e-16 at rest
        assert np.diff(energy).max() < (5e-15 if left else 4e-16) * energy[0]
        assert np.diff(states.work).max() <= 0
        along = np.asarray(states.p) @ B
        if left:
            np.testing.assert_allclose(along, along[0], rtol=0, atol=1e-14)
            # it ends turning about its major axis along b, which it cannot leave
            assert energy[-1] == pytest.approx(along[0] ** 2 / 2 / J[2], rel=1e-13, abs=0)
        else:
            assert energy[-1] < 1e-6 * energy[0]


@pytest.mark.quick
def test_the_impulse_of_a_thruster_is_that_of_its_window_whatever_the_steps():
    """A spin about a principal axis: Ω grows by T(stop − start)/J₃ and the work is ½J₃ΔΩ², for steps of any size."""
    start, stop, T = 0.333, 1.777, 0.4
    body = torqued_body(J, torques.thruster([0, 0, T], start, stop))
    step, state = torqued_midpoint(body), moving(J, [0, 0, 0.3])._replace(t=jnp.array(0.2), work=jnp.array(0.0))
    for num_steps in (1, 3, 10, 64):
        dt = jnp.array(1.6 / num_steps)
        end, info = after(step, state, dt, num_steps)
        gained = 0.3 + T * (stop - start) / J[2]
        assert info.converged
        np.testing.assert_allclose(end.p, [0, 0, 1] @ PRINCIPAL * J[2] * gained, rtol=0, atol=4e-15)
        assert float(end.work) == pytest.approx(J[2] * (gained**2 - 0.3**2) / 2, rel=1e-14, abs=0)
        np.testing.assert_allclose(after(step, end, -dt, num_steps)[0].p, state.p, rtol=0, atol=4e-15)


DISSIPATIVE = {
    "viscous": torqued_body(J, torques.viscous(0.003 * D)),
    "pd_trace": torqued_body(J, torques.pd_trace(0.7, 0.2, TARGET)),
    "pd_quaternion": torqued_body(J, torques.pd_quaternion(0.7, 0.2, TARGET)),
    "bdot": torqued_body(J, torques.bdot(0.001, field)),
    "kane_damper": torqued_body(J, torques.kane_damper(0.4, 0.3)),
    "internal friction": damped_body(J, 0.02),
}
SIZES = np.array([0.001, 0.01, 0.1, 0.5, 0.9])
SPINS_ON = ("kane_damper", "internal friction")  # about the major axis; the others come to rest


@functools.partial(jax.jit, static_argnums=(0, 4))
@functools.partial(jax.vmap, in_axes=(None, 0, None, None, None))
@functools.partial(jax.vmap, in_axes=(None, None, 0, None, None))
def gains(name, row, dt, start, num_steps):
    """The largest gain of energy in a step that converged, of work done, the steps that did, the energy in the end."""
    body = DISSIPATIVE[name]
    step = torqued_midpoint(body, chosen(row))

    def step_once(carry, _):
        state, energy, most, work, count = carry
        end, info = step(state, dt)
        end = jax.tree.map(functools.partial(jnp.where, info.converged), end, state)
        now = body.energy(end)
        most, work = jnp.maximum(most, now - energy), jnp.maximum(work, end.work - state.work)
        return (end, now, most, work, count + info.converged), None

    lowest = jnp.array(-jnp.inf)
    carry = (start, body.energy(start), lowest, lowest, jnp.zeros((), int))
    _, energy, most, work, count = jax.lax.scan(step_once, carry, None, length=num_steps)[0]
    return most / body.energy(start), work, count, energy / body.energy(start)


@pytest.mark.parametrize("name", DISSIPATIVE)
def test_dissipation_never_raises_the_energy(name):
    """Each single step of 10⁵, each κ, Δt to |ΔtΩ| = 0.9; one that does not converge is not taken."""
    start = DISSIPATIVE[name].state(Q, angular_velocity=[0.6, 0.3, -0.7], work=0.0)
    most, work, count, left = jax.device_get(gains(name, np.eye(3), SIZES, start, 100_000))
    assert (count[:, :4] == 100_000).all()
    assert (count[0] == 100_000).all()
    assert work.max() <= 0  # to the last bit
    # of the energy in the beginning; the energy of a body that spins has a rounding error of its own, 3e-15 seen
    assert most.max() <= (5e-15 if name in SPINS_ON else 5e-16)  # 3e-16
    assert left[:, 1:4].max() < 0.9


@pytest.mark.parametrize("name", SPINS_ON)
def test_the_energy_of_a_body_that_spins_on_does_not_rise_beyond_the_rounding_of_energy(name):
    """Once it spins about its major axis: by the attitude that q stands for, in 30 digits."""
    body, step = DISSIPATIVE[name], torqued_midpoint(DISSIPATIVE[name])
    start, _ = after(step, body.state(Q, angular_velocity=[0.6, 0.3, -0.7], work=0.0), jnp.array(0.5), 20_000)
    states = jax.device_get(path(step, start, 0.5, 1000)[0])
    with mpmath.workdps(30):
        exact = np.vectorize(mpmath.mpf, otypes=[object])
        q, p = exact(states.q), exact(states.p)
        q2 = np.sum(q * q, axis=1)
        Pi = [sum(a * b for a, b in zip(row, p.T, strict=True)) for row in rows(*(q.T / np.sqrt(q2)))]
        energy = sum(P * P / (2 * mpmath.mpf(float(j))) for P, j in zip(Pi, J, strict=True))
        if states.extra is not None:
            energy = energy + np.sum(exact(states.extra["damper"]) ** 2, axis=1) / (2 * mpmath.mpf(0.4))
        assert float(max(np.diff(energy)) / energy[0]) < 5e-16


def dop853(name, start, T):
    """Quaternion kinematics, Euler's equations with the torque, a damper and the work, by scipy."""
    constant = jnp.array([0.3, -0.5, 0.2])

    @jax.jit
    def rate(t, y):
        q, p, damper = y[:4], y[4:7], y[7:10]
        L = so3.to_matrix(q)
        Pi = L.T @ p
        Omega = jnp.linalg.solve(FULL, Pi)
        slip = jnp.cross(Pi, Omega)
        turn, torque, rest = Omega, jnp.zeros(3), jnp.zeros(3)
        power = jnp.zeros(())
        if name == "internal friction":
            turn, power = Omega + 0.3 * slip, -0.3 * slip @ slip
        elif name == "kane_damper":
            torque = -0.3 * (L @ Omega - damper / 0.4)
            rest, power = -torque, torque @ (L @ Omega - damper / 0.4)
        elif name == "thruster":
            torque, power = L @ constant, Omega @ constant  # inside its window
        else:
            omega = Omega if BODIES[name].frame == "body" else L @ Omega
            torque = of_law(name, t, q, omega)
            power = -0.2 * omega @ omega if name.startswith("pd") else omega @ torque
            torque = L @ torque if BODIES[name].frame == "body" else torque
        q_dot = so3.multiply(q, jnp.concatenate([jnp.zeros(1), turn])) / 2
        return jnp.concatenate([q_dot, torque, rest, power[None]])

    damper = np.zeros(3) if start.extra is None else start.extra["damper"]
    y = np.concatenate([start.q, start.p, damper, [0.0]])
    span = (float(start.t), float(start.t) + T)
    return solve_ivp(lambda t, y: np.asarray(rate(t, y)), span, y, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


def flat(state):
    damper = np.zeros(3) if state.extra is None else state.extra["damper"]
    return np.concatenate([state.q, state.p, damper, [state.work]])


@pytest.mark.parametrize("name", BODIES)
def test_torqued_steps_have_their_order_against_another_package(name):
    """Of the step 2, of its composition 4, in the attitude, the momenta and the work at once."""
    body = BODIES[name]
    start = body.state(Q, angular_velocity=OMEGA, t=0.4, work=0.0)
    if start.extra is not None:
        start = start._replace(extra={"damper": jnp.array([0.1, -0.3, 0.2])})
    T, step = 1.2, torqued_midpoint(body)
    exact = dop853(name, start, T)
    for tried, order, counts in ((step, 2, (20, 40, 80)), (schemes.compose(step, 4), 4, (8, 16))):
        errors = np.array([np.abs(flat(after(tried, start, T / n, n)[0]) - exact).max() for n in counts])
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:])[-1], order, rtol=0, atol=0.2)
        assert errors[-1] > 1e-11


@pytest.mark.parametrize("name", BODIES)
def test_derivatives_forward_reverse_by_reversal_and_by_differences(name):
    """In the inertia, each number of the law, the state, the time, the work and a damper's momentum."""
    start = BODIES[name].state(Q, angular_velocity=OMEGA, t=0.2, work=0.0)
    slopes.assert_agree(torqued_midpoint(BODIES[name]), start, 0.15)


@pytest.mark.quick
def test_a_law_with_more_than_a_value_must_inherit_from_law():
    """A potential that nobody asks for would be missing in the energy, without a sign."""

    class Spring:
        def __call__(self, t, q, omega):
            return -q[1:]

        def potential(self, q):
            return 2 * (1 - q[0])

    for law in (Spring(), li.pytree(Spring)(), li.torques.viscous(0.1) + li.torques.viscous(0.2)):
        if isinstance(law, li.torques.Law):
            torqued_body(J, law)
            continue
        with pytest.raises(ValueError, match=r"has no potential, as Spring has: .* inherits li\.torques\.Law"):
            torqued_body(J, law)


def until(x, t, q, omega):
    """A torque that is NaN from t = x on."""
    return jnp.sqrt(x - t) * omega


def test_a_torque_that_becomes_nan_is_flagged_and_at_the_start_refused():
    start = moving(J)._replace(t=jnp.array(0.0))
    steps_to = {x: torqued_midpoint(torqued_body(J, jax.tree_util.Partial(until, x))) for x in (0.35, -0.1)}
    run = li.integrate(steps_to[0.35], start, 0.1, 6)
    np.testing.assert_array_equal(run.info.converged, [1, 1, 1, 1, 0, 0, 0])
    with pytest.raises(ValueError, match=r"the torque must be finite, got \[nan nan nan\] at t = 0.* fix the law"):
        li.integrate(steps_to[-0.1], start, 0.1, 6)
    assert not after(steps_to[-0.1], start, jnp.array(0.1), 1)[1].converged  # inside jit nothing raises


def test_work_is_counted_on_request_only_and_other_extra_arrays_are_preserved():
    for name in ("viscous", "kane_damper", "internal friction"):
        start = BODIES[name].state(Q, angular_velocity=OMEGA, work=0.0)
        start = start._replace(extra=(start.extra or {}) | {"note": jnp.arange(2.0)})
        step = torqued_midpoint(BODIES[name])
        ends = [after(step, z, jnp.array(0.1), 3)[0] for z in (start, start._replace(work=None))]
        assert ends[1].work is None
        for one, other in zip(jax.tree.leaves(ends[0]._replace(work=None)), jax.tree.leaves(ends[1]), strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(ends[1].extra["note"], [0, 1])
