"""Gyrostats: what each scheme keeps, and what it cannot; a motor; the rule of the dual-spin satellite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from equations import quaternion_rate
from free_bodies import Q, angle, rows, turned
from repeated import after

import lieint_jax as li
from lieint_jax import State, schemes, systems
from lieint_jax.core.tangent import value_and_jacobian
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

pytestmark = pytest.mark.long

KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)
J, H_R = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.6, 0.5])
OMEGA = np.array([0.3, -0.5, 0.8])
EPS = np.finfo(float).eps


def to_body(q, v):
    return np.array(rows(*q)) @ v


def moving(J, rotor, Omega=OMEGA, **more):
    """The state at Q of body velocity Ω, without a program of its own."""
    J = np.asarray(J)
    Pi = (J @ Omega if J.ndim == 2 else J * Omega) + rotor
    return State(jnp.array(Q), jnp.array(np.array(rows(*Q)).T @ Pi), **more)


GYROSTAT, FULL = systems.gyrostat(J, H_R), systems.gyrostat(turned(J), H_R)
STATE = moving(J, H_R)
MOTOR = systems.SpinUpMotor(jnp.array([0.4, 0.9, -0.5]), jnp.array(4.0))
DRIVEN = systems.driven_gyrostat(J, MOTOR)
START = moving(J, H_R, t=jnp.array(0.0), work=jnp.array(0.0), extra={"rotor": jnp.array(H_R)})
ZERO = {"t": jnp.array(0.0), "work": jnp.array(0.0), "extra": {"rotor": jnp.zeros(3)}}


@jax.jit
def history(step, state, dt):
    """The errors of energy less work over |Ω||π|, of momentum and |q|, over 2000 steps, and whether all converged."""
    run = li.Run.of(step, li.integrate(step, state, dt, 2000, save_every=20))
    unit = jnp.linalg.norm(step.system.angular_velocity(state)) * jnp.linalg.norm(state.p)
    energy = run.energy_error() / unit
    momentum = run.momentum_error()
    length = run.constraint_error()
    return [jnp.max(jnp.abs(x)) for x in (energy, momentum, length)], run.info.converged.all()


@pytest.mark.quick
def test_the_rate_of_a_motor_s_work_is_that_of_the_energy():
    @jax.jit
    def both(state):
        rate = DRIVEN.vector_field(state)
        return jax.jvp(DRIVEN.energy, (state,), (rate._replace(t=jnp.ones(())),))[1], rate.work

    energy, work = both(START._replace(t=jnp.array(1.3)))
    assert float(energy) == pytest.approx(float(work), rel=1e-13, abs=0)
    assert abs(work) > 0.01


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_every_kappa_conserves_energy_to_round_off_and_momentum_bit_for_bit(kappa):
    for rotor in (H_R, np.array([0.0, 0.0, 10.0])):
        step = schemes.so3_midpoint(systems.gyrostat(J, rotor), kappa)
        (energy, momentum, length), converged = history(step, moving(J, rotor), 0.1)
        assert converged
        assert energy < 2e-14  # floor 4e-15, with the fast rotor
        assert momentum == 0
        assert length < 4 * EPS


def test_a_full_tensor_is_the_same_gyrostat_in_other_axes():
    moments, axes = np.linalg.eigh(FULL.inertia)
    axes[:, 2] *= np.linalg.det(axes)
    same = systems.gyrostat(moments, axes.T @ H_R)
    state = moving(FULL.inertia, H_R)
    q = li.groups.so3.multiply(state.q, li.groups.so3.from_matrix(jnp.array(axes)))
    ends = [after(schemes.so3_midpoint(s), z, 0.1, 50)[0] for s, z in ((FULL, state), (same, State(q, state.p)))]
    other = li.groups.so3.multiply(ends[0].q, li.groups.so3.from_matrix(jnp.array(axes)))
    assert angle(other, ends[1].q) < 3e-14  # floor 4e-15


def test_a_gyrostat_without_rotor_momentum_is_the_free_body():
    body, still = systems.rigid_body(J), systems.gyrostat(J, np.zeros(3))
    state = body.state(Q, angular_velocity=OMEGA)
    np.testing.assert_array_equal(still.state(Q, angular_velocity=OMEGA).p, state.p)
    assert float(still.energy(state)) == pytest.approx(float(body.energy(state)), rel=1e-15, abs=0)
    for free, own in (
        (schemes.so3_midpoint(body, kappa_cayley), schemes.so3_midpoint(still, kappa_cayley)),
        (schemes.exact(body), schemes.splitting(still)),
    ):
        assert angle(after(free, state, 0.3, 3)[0].q, after(own, state, 0.3, 3)[0].q) < 4e-15  # floor 3e-16


@jax.jit
def defects(step, state, dts, rotors):
    """The largest symplectic defect, of every step size with every rotor."""

    def defect(dt, rotor):
        made = dataclasses.replace(step, system=systems.Gyrostat(step.system.inertia, rotor))
        return li.diagnostics.symplectic_defect(made, state, dt)

    return jax.vmap(lambda dt: jax.vmap(lambda rotor: defect(dt, rotor))(rotors))(dts)


DTS = np.array([0.05, 0.025, 0.0125, -0.1])
ROTORS = H_R * np.array([0, 0.01, 0.02, 1])[:, None]


@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_refuted_no_kappa_is_symplectic_for_a_gyrostat(kappa):
    """The defect of a step is O(Δt³), and of the first order in the rotor's momentum. Without it, the symplectic κ
    has none, for which b in curl_h[(Ψ − h × Ψ)/(1 + |h|²)] is to blame."""
    found = np.asarray(defects(schemes.so3_midpoint(GYROSTAT, kappa), STATE, DTS, ROTORS))
    slopes = np.log2(found[:2, 3] / found[1:3, 3])
    np.testing.assert_allclose(slopes, 3, rtol=0, atol=0.06)
    assert found[0, 3] > 4e-6
    if kappa is kappa_symplectic:
        assert found[:, 0].max() < 4e-15  # floor 9e-16
        np.testing.assert_allclose(found[:, 2] / found[:, 1], 2, rtol=0.03)


@pytest.mark.quick
def test_the_default_splitting_conserves_momentum_and_the_energy_of_a_nearby_hamiltonian():
    errors = []
    for dt in (0.1, 0.05):
        (energy, momentum, length), converged = history(schemes.splitting(GYROSTAT), STATE, dt)
        assert converged
        assert momentum == 0
        assert length < 8 * EPS
        errors.append(float(energy))
    assert errors[0] / errors[1] == pytest.approx(4, abs=0.3)
    assert errors[0] < 2e-3


@pytest.mark.quick
def test_a_gyrostat_splitting_accepts_other_drifts_of_the_same_body_only():
    assert schemes.splitting(GYROSTAT, schemes.so3_explicit(GYROSTAT.free)).name == "splitting[so3_explicit]"
    with pytest.raises(ValueError, match=r"splitting with exact: the drift must be a step of system\.free"):
        schemes.splitting(GYROSTAT, schemes.exact(systems.rigid_body([1.0, 2.0, 2.9])))


def dop853(J, z, t, motor=None, rtol=1e-13):
    """Quaternion kinematics, Euler's equations, the rotor and the work, by scipy."""
    J, rotor = np.asarray(J), np.asarray(H_R if z.extra is None else z.extra["rotor"])

    def f(t, y):
        q, Pi, h = y[:4], y[4:7], y[7:10]
        Omega = (Pi - h) / J
        torque = np.zeros(3) if motor is None else np.asarray(motor(t))
        return np.concatenate([quaternion_rate(q, Omega), np.cross(Pi, Omega), torque, [-Omega @ torque]])

    start = np.concatenate([z.q, to_body(z.q, z.p), rotor, [0.0]])
    return scipy.integrate.solve_ivp(f, (0, t), start, "DOP853", rtol=rtol, atol=1e-13).y[:, -1]


def spin_up(t):
    """`MOTOR` by numpy."""
    return np.asarray(MOTOR.momentum) / 4 * (1 - np.cos(2 * np.pi * min(max(t / 4, 0), 1)))


def test_a_driven_gyrostat_against_another_package_and_the_reference_flow():
    step, errors = schemes.so3_midpoint(DRIVEN, kappa_cayley), []
    expected = dop853(J, START, 3.0, spin_up)
    for n in (30, 60, 120):
        end, _ = after(step, START, 3 / n, n)
        found = np.concatenate([end.q, to_body(end.q, end.p), end.extra["rotor"], [end.work]])
        errors.append(np.abs(found - expected))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(rates, 2, rtol=0, atol=0.15)
    flow = li.diagnostics.flow(DRIVEN, START, 3.0, 12)
    np.testing.assert_allclose(
        [*flow.q, *flow.extra["rotor"], flow.work], expected[[*range(4), *range(7, 11)]], rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_the_work_of_a_motor_is_the_gain_of_energy(kappa):
    step = schemes.so3_midpoint(DRIVEN, kappa)
    (energy, momentum, length), converged = history(step, START, 0.1)
    assert converged
    assert energy < 1e-14  # floor 2e-15
    assert momentum == 0
    assert length < 4 * EPS
    end, _ = after(step, START, 0.1, 40)
    np.testing.assert_allclose(
        end.extra["rotor"] - H_R, MOTOR.momentum, rtol=0, atol=4e-15
    )  # a midpoint sum of whole periods
    assert abs(float(end.work)) > 0.1
    assert float(end.t) == pytest.approx(4, rel=5e-15, abs=0)


@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_each_step_balances_the_power(kappa):
    """ΔH = −Ω̄·Δh_r with Ω̄ = J⁻¹(mean of Π − h_r), by numpy, in one step of random motion."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        h, Omega = rng.normal(size=(2, 3))
        start = moving(J, h, Omega, **ZERO | {"t": jnp.array(rng.uniform(0.5, 3)), "extra": {"rotor": jnp.array(h)}})
        end, info = after(schemes.so3_midpoint(DRIVEN, kappa), start, 0.3, 1)
        own = [to_body(z.q, z.p) - z.extra["rotor"] for z in (start, end)]
        change = np.asarray(end.extra["rotor"]) - h
        gain = (own[1] @ (own[1] / J) - own[0] @ (own[0] / J)) / 2
        assert info.converged
        assert abs(gain + (own[0] + own[1]) / 2 / J @ change) < 2e-14 * max(1, np.abs(h).max())  # floor 4e-15
        assert abs(gain - float(end.work)) < 2e-14


def test_a_wheel_absorbs_all_momentum_and_the_body_stops():
    """A spin about a principal axis, whose wheel gains all of it: the body rests, and the work is −½JΩ²."""
    wheel = systems.driven_gyrostat(J, systems.SpinUpMotor(jnp.array([0.0, 0.0, 3 * 0.4]), jnp.array(4.0)))
    start = moving(J, np.zeros(3), np.array([0, 0, 0.4]), **ZERO)
    end, info = after(schemes.so3_midpoint(wheel), start, 0.1, 40)
    assert info.converged
    np.testing.assert_allclose(to_body(end.q, end.p) - end.extra["rotor"], 0, rtol=0, atol=4e-15)
    assert float(end.work) == pytest.approx(-0.5 * 3 * 0.4**2, rel=1e-13, abs=0)


def test_a_slow_wheel_turns_the_satellite_about_its_momentum():
    """A satellite that spins about its major axis 1 spins up a wheel along axis 3. The spin stays steady, about an axis
    between: Ω₁ = Π₁/J₁ and Ω₃ = (Π₃ − h)/J₃ are as Π₁ to Π₃, so Π₃ = h/(1 − J₃/J₁) (Barba & Aubrun 1976)."""
    moments = np.array([3.0, 2.5, 2.0])
    motor = systems.SpinUpMotor(jnp.array([0.0, 0.0, 0.3]), jnp.array(300.0))
    start = moving(moments, np.zeros(3), np.array([0.5, 0, 0]), **ZERO)
    end, _ = after(schemes.so3_midpoint(systems.driven_gyrostat(moments, motor), kappa_exponential), start, 0.2, 1500)
    np.testing.assert_allclose(
        to_body(end.q, end.p), [1.2, 0, 0.9], rtol=0, atol=2e-3
    )  # 6e-4, and falls as 1/duration³


def test_work_is_None_unless_the_state_tracks_it():
    end, _ = after(schemes.so3_midpoint(DRIVEN), START._replace(work=None), 0.1, 3)
    assert end.work is None
    more = START._replace(extra=START.extra | {"note": jnp.ones(2)})
    np.testing.assert_array_equal(after(schemes.so3_midpoint(DRIVEN), more, 0.1, 3)[0].extra["note"], [1, 1])
    assert DRIVEN.vector_field(more).extra["note"].shape == (2,)


@jax.jit
@jax.vmap
def growth(J, spin, wheel):
    """The modulus and the angle of the largest eigenvalue of a step about a steady spin, seen from the body."""
    dt = 0.05
    gyrostat = systems.Gyrostat(J, wheel * jnp.array([0.0, 0.0, 1.0]))
    Pi = J * jnp.array([0.0, 0.0, 1.0]) * spin + gyrostat.rotor
    state = State(jnp.array([1.0, 0.0, 0.0, 0.0]), Pi)
    end, _, L = value_and_jacobian(
        gyrostat.phase_space, lambda z: schemes.SO3Midpoint(gyrostat, kappa_cayley, 4)(z, dt), state
    )
    return li.groups.so3.to_matrix(end.q).T @ L[:3, :3]


def test_a_spin_is_stable_by_the_rule_of_the_gyrostat_and_of_no_other():
    """Without dissipation: (λ − J₁Ω)(λ − J₂Ω) > 0 with λ = J₃Ω + h_r; and the rate is the root of it over J₁J₂."""
    Omega, dt = 0.5, 0.05
    h = np.linspace(-3, 3, 41) * Omega
    for moments in ([2.0, 2.5, 3.0], [2.0, 3.0, 2.5], [2.5, 3.0, 2.0], [2.5, 2.5, 2.0]):
        step = np.asarray(growth(np.tile(moments, (41, 1)), np.full(41, Omega), h))
        values = np.linalg.eigvals(step)
        margin = ((moments[2] - moments[0]) * Omega + h) * ((moments[2] - moments[1]) * Omega + h)
        sure = np.abs(margin) > 1e-3
        grows = np.abs(values).max(axis=1) > 1 + 1e-6
        np.testing.assert_array_equal(grows[sure], (margin < 0)[sure])
        rate = np.abs(np.log(values)).max(axis=1) / dt
        np.testing.assert_allclose(rate[sure], np.sqrt(np.abs(margin[sure]) / (moments[0] * moments[1])), rtol=3e-3)


def nutation_with_a_damper(moments, h, spin, seconds=400.0):
    """The angle of Π from axis 3 in the end over that in the beginning, with Kane's damper: a sphere of moment D in a
    viscous fluid, which takes energy and no momentum. By scipy."""
    D, c = 0.2, 0.1
    own, rotor = np.asarray(moments) - D, np.array([0, 0, h])

    def f(_, y):
        Pi, p = y[:3], y[3:]
        Omega = (Pi - rotor - p) / own
        return np.concatenate([np.cross(Pi, Omega), np.cross(p, Omega) + c * (Omega - p / D)])

    Omega = spin * np.array([0.02, 0.0, 1.0])
    start = np.concatenate([own * Omega + rotor + D * Omega, D * Omega])
    ends = scipy.integrate.solve_ivp(f, (0, seconds), start, "DOP853", rtol=1e-9, atol=1e-12).y[:3, [0, -1]]
    across = np.linalg.norm(ends[:2], axis=0) / np.linalg.norm(ends, axis=0)
    return across[1] / across[0]


def test_with_a_damper_the_rule_is_that_of_the_major_axis():
    """λ/Ω must be above both J₁ and J₂, or negative: less stable than without. A prolate body, stable without a wheel
    and without a damper, is stable with a wheel that makes λ/Ω the largest."""
    moments, spin = [2.5, 2.4, 2.0], 1.0
    for h in (0.0, 0.2, 0.8, 2.0, -0.3):
        stable = moments[2] * spin + h > 2.5 * spin
        without = (moments[2] * spin + h - 2.5 * spin) * (moments[2] * spin + h - 2.4 * spin) > 0
        assert without
        assert (nutation_with_a_damper(moments, h, spin) < 1) == stable


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def test_a_motor_of_doubles_drives_a_satellite_of_singles():
    driven = systems.driven_gyrostat(np.float32(J), lambda t: [0.0, np.float64(0.1), 0.2 * t])
    end, _ = after(schemes.so3_midpoint(driven), single(START), jnp.float32(0.1), 2)
    assert {x.dtype for x in jax.tree.leaves(end)} == {jnp.dtype(jnp.float32)}


def test_a_motor_without_a_value_is_flagged_where_nothing_can_be_raised():
    nowhere = systems.driven_gyrostat(J, lambda t: jnp.stack([t, t, jnp.log(t - 1)]))
    assert not after(schemes.so3_midpoint(nowhere), START, 0.1, 1)[1].converged
