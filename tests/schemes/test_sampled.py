"""Digital controllers: laws that sample the state at equal times and hold their torque in between."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated import last, once

import lieint_jax as li
from lieint_jax import core, schemes, systems, torques
from lieint_jax.groups import so3

PERIOD, DT, MOMENTS = 0.1, 0.025, [1.0, 2.0, 2.5]
DRAG = torques.viscous(0.01)


@jax.tree_util.Partial
def FIELD(t):
    return jnp.stack([jnp.sin(0.3 * t), 0.2 + 0 * t, jnp.cos(0.3 * t)])


LAW = torques.bdot(0.5, FIELD, max_dipole=0.4)


def satellite(period=PERIOD, law=LAW, **options):
    body = systems.torqued_body(MOMENTS, torques.sampled(law, period) + DRAG)
    return schemes.torqued_midpoint(body), body.state(angular_velocity=[1.0, -0.5, 0.8], work=0.0, **options)


@jax.jit
def between_samples(state):
    """Four steps with a constant torque, the one of the law at the start."""
    Omega = so3.Ad_star(state.q, state.p) / jnp.array(MOMENTS)
    held = torques.thruster(LAW(state.t, state.q, Omega), -1e9, 1e9)
    step = schemes.torqued_midpoint(systems.torqued_body(MOMENTS, held + DRAG))
    return li.integrate(step, state, DT, 4)


def held_in_a_loop(run, between, z, key, **near):
    """What a run of 400 steps holds in each sample; its states are near those of a loop over the samples in Python."""
    for k in range(100):
        found = between(z)
        for name in ("q", "p", "work"):
            series = getattr(run.state, name)[4 * k : 4 * k + 5]
            np.testing.assert_allclose(series, getattr(found.state, name), **near)
        z = last(found)
    held = run.state.extra[key][1:].reshape(100, 4, 3)
    assert (held == held[:, :1]).all()
    return held


def test_a_sampled_law_is_that_of_a_loop_with_a_constant_torque_between_samples():
    """To round-off: another program. Observed: 3e-15 after 400 steps."""
    step, state = satellite(works=True)
    run = li.run(step, state, DT, 400)
    held = held_in_a_loop(run, between_samples, state._replace(extra=None), "sampled", rtol=0, atol=2e-14)
    assert (np.abs(np.diff(held[:, 0], axis=0)).max(axis=1) > 0).all()
    assert abs(run.energy_error()).max() < 1e-14
    assert run.state.extra["works"][-1, 0] < -0.3
    assert run.converged


@pytest.mark.parametrize("digital", [False, True])
def test_a_law_acts_in_its_window_only(digital):
    """From 1 to 3 of 4. In between the run is one of the law alone. To round-off: another program. Observed: 0."""

    def run(law, q, p, t, num_steps):
        body = systems.torqued_body(MOMENTS, torques.sampled(law, PERIOD) if digital else law)
        found = li.run(schemes.torqued_midpoint(body), body.state(q, spatial_momentum=p, t=t), DT, num_steps)
        return found.state.q, found.state.p

    law = torques.bdot(0.5, FIELD)  # in the axes of space
    q, p = run(torques.windowed(law, 1.0, 3.0), [1.0, 0.0, 0.0, 0.0], [1.0, -1.0, 2.0], 0.0, 160)
    assert (p[:41] == p[0]).all()
    assert (p[120:] == p[120]).all()
    alone = run(law, q[40], p[40], 1.0, 80)
    np.testing.assert_allclose(q[40:121], alone[0], rtol=0, atol=4e-15)
    np.testing.assert_allclose(p[40:121], alone[1], rtol=0, atol=4e-15)
    assert np.linalg.norm(p[120]) < 0.9 * np.linalg.norm(p[0])


WHEELS = functools.partial(torques.wheels, jnp.eye(3), 0.05, max_torque=0.3)
MOTOR = torques.wheel_motor(jnp.eye(3), torques.pd_quaternion(0.4, 0.5))


def carrier(motor, **options):
    """A body with wheels, at rest in it at the start."""
    body = systems.torqued_body(MOMENTS, WHEELS(motor, **options))
    return schemes.torqued_midpoint(body), body.state(angular_velocity=[0.4, -0.2, 0.3], work=0.0)


@jax.jit
def with_constant_motors(state):
    """Four steps with the torques of the motors at the start."""
    Omega, h = so3.Ad_star(state.q, state.p) / jnp.array(MOMENTS), state.extra["wheels"]
    torque = MOTOR(state.t, state.q, Omega, h)
    step, _ = carrier(jax.tree_util.Partial(lambda held, *_: held, torque))
    return li.integrate(step, state, DT, 4)


def test_sampled_wheels_are_those_of_a_loop_with_constant_motors_between_samples():
    """Observed after 400 steps: states 1e-15, works of 16 4.6e-14, momentum 1.4e-15, energy 1.5e-14."""
    step, state = carrier(MOTOR, period=PERIOD)
    run = li.run(step, state, DT, 400)
    assert run.converged
    assert not step.symmetric
    z = state._replace(extra={"wheels": state.extra["wheels"]})
    held_in_a_loop(run, with_constant_motors, z, "motors", rtol=1e-14, atol=5e-15)
    assert abs(run.momentum_error()).max() < 6e-15
    assert abs(run.energy_error()).max() < 6e-14
    assert np.linalg.norm(run.state.p[-1]) < 0.4 * np.linalg.norm(run.state.p[0])  # the wheels took it over


@core.pytree
class Held(core.Law):
    """A constant torque in the body."""

    torque: jax.Array
    label = "held"

    def mean(self, rotation, inner):
        return self.torque, inner


@pytest.mark.long
def test_it_is_a_loop_written_by_hand_bit_for_bit():
    """Both in machine code, at the times of the run's nodes."""
    satellite = systems.torqued_body(MOMENTS, torques.sampled(LAW, PERIOD))
    step, start = schemes.torqued_midpoint(satellite), satellite.state(angular_velocity=[1.0, -0.5, 0.8], work=0.0)
    run = li.run(step, start, DT, 400)

    def by_hand(state, times):
        def advance(carry, now):
            state, torque = carry
            n, t, dt = now
            state = state._replace(t=t)
            torque = jnp.where(n % 4 == 0, LAW(t, state.q, satellite.now(state).Omega), torque)
            state, _ = schemes.torqued_midpoint(systems.torqued_body(MOMENTS, Held(torque)))(state, dt)
            return (state, torque), (state, torque)

        nodes = jnp.arange(400), times[:-1], jnp.diff(times)
        return li.scan(advance, (state, jnp.zeros(3)), nodes)[1]

    given = start._replace(extra=None), jnp.asarray(run.state.t)
    assert li.explain(by_hand, *given).engines == {"native"}
    found, held = jax.jit(by_hand)(*given)
    for name in ("q", "p", "work"):
        np.testing.assert_array_equal(getattr(found, name), getattr(run.state, name)[1:])
    np.testing.assert_array_equal(held, run.state.extra["sampled"][1:])


@pytest.mark.long
def test_it_runs_in_machine_code():
    step, state = satellite()
    assert li.explain(lambda z: li.integrate(step, z, DT, 10), state).engines == {"native"}
    assert not step.symmetric
    assert li.core.labels(step.system) == ["sampled", "viscous"]


@pytest.mark.long
@pytest.mark.parametrize(("sampled", "floor"), [("law", 1e-14), ("wheels", 1e-13)])
def test_a_certificate_measures_order_2_across_samples_and_finds_no_way_back(sampled, floor):
    """Of wheels with works of 16. Observed energies 1e-15 and 2.5e-14."""
    step, state = satellite() if sampled == "law" else carrier(MOTOR, period=PERIOD)
    certificate = li.diagnostics.certify(step, state, DT, 200)
    assert abs(certificate.order - 2) < 0.05
    assert certificate.energy < floor
    assert certificate.converged
    assert np.isinf(certificate.reversibility)
    assert re.search(r"reversibility +inf   not reversible: a step of −dt is refused", str(certificate))


@pytest.mark.parametrize(("dt", "t"), [(0.03, 0.0), (-0.025, 0.1), (0.2, 0.0), (0.025, 0.01)])
@pytest.mark.long
def test_steps_that_could_pass_over_a_sample_are_refused(dt, t):
    step, state = satellite(t=t)
    assert not once(step, state, dt)[1].converged
    with pytest.raises(ValueError, match=r"sampled samples at multiples of 0\.1, .* give a dt > 0 that divides 0\.1"):
        li.run(step, state, dt, 4)


@pytest.mark.long
def test_steps_of_many_lengths_find_their_samples():
    """Also where the time is rounded: t = 10⁴ periods, and a period of one step."""
    for period, dt, t in ((0.1, 0.1, 0.0), (0.1, 0.1 / 7, 0.0), (0.7, 0.1, 7000.0), (3.0, 0.001, 3e4)):
        step, state = satellite(period, t=t)
        other = state._replace(extra={"sampled": jnp.ones(3)})
        end, info = once(step, other, dt)
        assert info.converged
        np.testing.assert_allclose(end.extra["sampled"], state.extra["sampled"], rtol=1e-14)
        if dt < period:
            end, info = once(step, other._replace(t=jnp.asarray(t + dt)), dt)
            assert info.converged
            np.testing.assert_array_equal(end.extra["sampled"], 1)


@pytest.mark.long
def test_a_sum_of_laws_is_sampled_on_a_body_with_wheels_whose_inertia_changes():
    """Each sample looks at Ω = J(t)⁻¹Π of its own time. Both works are booked."""
    inertia = lambda t: jnp.array(MOMENTS) + 0.1 * t  # noqa: E731
    control = torques.pd_quaternion(0.4, 0.5) + LAW
    laws = torques.sampled(control, 0.2, key="computer") + torques.wheels(jnp.eye(3), 0.05, speeds=[1.0, -2.0, 0.5])
    body = systems.inertia_in_time(inertia, torque=laws)
    state = body.state(angular_velocity=[0.4, -0.2, 0.3], works=True)
    run = li.run(schemes.torqued_midpoint(body), state, 0.05, 200)
    assert run.converged
    assert abs(run.energy_error()).max() < 1e-14
    k = 17 * 4
    z = jax.tree.map(lambda x: jnp.asarray(x[k]), run.state)
    now = functools.partial(torques.sampled(control, 0.2).start, body.frozen(z.t).now(z))
    np.testing.assert_allclose(run.state.extra["computer"][k + 1], now(), rtol=1e-12)
