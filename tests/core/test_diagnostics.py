"""The measuring instruments: each against something that is not itself, on the whole grid of systems and schemes."""

import dataclasses

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from grid import systems
from internals import largest_at_once

import lieint_jax as li
from lieint_jax import _discover, diagnostics
from lieint_jax.core import State, Step, StepInfo, pytree
from lieint_jax.core.tangent import value_and_jacobian
from lieint_jax.groups import so3

BODIES = jax.jit(_discover.modules_with("examples", li.systems)["rigid_body"].examples)()
GRID = {  # every scheme that takes a rigid body
    f"rigid_body.{name}-{step_name}": (step, jax.tree.map(np.asarray, state), float(dt))
    for name, (body, state, dt) in BODIES.items()
    if name in ("asymmetric", "full_tensor")
    for module in _discover.modules_with("examples", li.schemes).values()
    for step_name, step in module.examples(body).items()
}
PAPER = [name for name in GRID if "-so3_midpoint[" in name]
BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = jax.jit(BODY.state)(np.array([1.0, 2, -1, 0.5]) / 2.5, angular_velocity=[0.3, -0.5, 0.8])
flow = jax.jit(diagnostics.flow, static_argnums=3)


@pytree
class Euler(Step):
    """Explicit Euler: a step that conserves nothing, to see that the instruments show it."""

    system: li.systems.RigidBody

    order, symmetric, name = 1, False, "explicit Euler"

    def advance(self, state, dt):
        rate = self.system.vector_field(state)
        return State(state.q + dt * rate.q, state.p + dt * rate.p), StepInfo(jnp.zeros(()), jnp.ones((), bool))


@jax.jit
def _poisson_errors(step, state, dt):
    return [diagnostics.poisson_error(step, state, dt, 1000, method=method) for method in ("recursion", "product")]


SPACES = {}  # a state of each kind of phase space, by the name of the first system of the grid with it
for _name, (_system, _state, _) in systems():
    SPACES.setdefault((type(_system.phase_space), _system.phase_space.dim), (_name, _system.phase_space, _state))


@pytest.mark.slow
@pytest.mark.parametrize(("space", "state"), [pytest.param(*x[1:], id=x[0]) for x in SPACES.values()])
def test_columns_of_a_derivative_one_by_one_are_those_of_all_at_once(monkeypatch, space, state):
    """Above 24 dimensions they are one by one; here for all phase spaces. Floor 3e-16, over the largest entry."""

    def moved(z):
        return space.perturb(z, 0.1 * jnp.sin(jnp.arange(1.0, space.dim + 1)) * z.q.ravel()[0]), z.p.sum()

    found = []
    for most in (0, space.dim):
        largest_at_once(monkeypatch, most)
        found.append(jax.jit(lambda z: value_and_jacobian(space, moved, z))(state))
    (end, aux, one_by_one), (expected, _, at_once) = found
    np.testing.assert_allclose(one_by_one, at_once, rtol=0, atol=1e-15 * np.abs(at_once).max())
    np.testing.assert_allclose(end.q, expected.q, rtol=0, atol=1e-15 * np.abs(expected.q).max())
    assert aux == pytest.approx(float(state.p.sum()), rel=1e-12, abs=0)


@pytest.mark.parametrize("name", [name for name in PAPER if "asymmetric-" in name or "full" in name])
@pytest.mark.slow
def test_poisson_error_by_recursion_and_by_product_of_jacobians(name):
    """(5.36) against (5.34) over 1000 steps, to round-off; and skew."""
    step, state, dt = GRID[name]
    J = step.system.inertia
    body = li.systems.rigid_body(np.diag(J) if J.ndim == 1 else J)  # full, so that both bodies share a program
    step = dataclasses.replace(step, system=body, iterations=2)  # to round-off at this dt
    recursion, product = map(np.asarray, _poisson_errors(step, state, dt))
    assert recursion.shape == (1001, 3, 3)
    np.testing.assert_allclose(recursion, product, rtol=0, atol=4e-12)  # floor 1.3e-12, all of it the product's
    np.testing.assert_allclose(recursion, -np.swapaxes(recursion, 1, 2), rtol=0, atol=1e-16)
    worst = np.abs(recursion).max()
    assert worst < 4e-14 if step.kappa.name == "symplectic" else worst > 1e-3  # floor 9e-15


def test_flow_converges_and_preserves_what_it_should():
    """The reference: self-consistent to round-off and on the invariants, which it does not know of."""
    coarse, fine = (flow(BODY, STATE, 10.0, n) for n in (20, 40))
    np.testing.assert_allclose(coarse.q, fine.q, rtol=0, atol=1e-14)  # floor 3e-15
    energy = jax.jit(BODY.energy)
    assert energy(fine) == pytest.approx(float(energy(STATE)), rel=1e-14, abs=0)
    back = flow(BODY, fine, -10.0, 40)
    np.testing.assert_allclose(back.q, STATE.q, rtol=0, atol=2e-14)


@pytest.mark.long
def test_the_reference_flow_agrees_with_25_digits():
    """A Taylor integration with mpmath, of the body momentum and the attitude together."""
    body_momentum = jax.jit(BODY.body_momentum)
    Pi = [mpmath.mpf(float(x)) for x in np.asarray(body_momentum(STATE))]

    def f(_, z):
        w, x, y, s, a, b, c = z
        O1, O2, O3 = a, b / 2, c / 3
        turning = [
            -x * O1 - y * O2 - s * O3,
            w * O1 + y * O3 - s * O2,
            w * O2 + s * O1 - x * O3,
            w * O3 + x * O2 - y * O1,
        ]
        return [*(t / 2 for t in turning), b * O3 - c * O2, c * O1 - a * O3, a * O2 - b * O1]

    with mpmath.workdps(30):
        start = [mpmath.mpf(float(x)) for x in np.asarray(STATE.q)]
        exact = mpmath.odefun(f, 0, start + Pi, tol=mpmath.mpf(10) ** -25, degree=25)(2)
    end = flow(BODY, STATE, 2.0, 5)
    ours = np.concatenate([end.q, body_momentum(end)])
    np.testing.assert_allclose(ours, [float(x) for x in exact], rtol=0, atol=5e-15)  # floor 1e-15


@pytest.mark.parametrize(
    ("energy", "verdict"),
    [
        (0.0, "conserved bit for bit"),
        (3e-13, "conserved to round-off, 12.5 digits"),
        (2e-12, "conserved to one rounding per step, 11.7 digits"),
        (3e-12, "not conserved, 11.5 digits"),
    ],
)
def test_verdicts_distinguish_random_rounding_from_one_rounding_per_step(energy, verdict):
    """After 10 000 steps 16 ε√n is 3.6e-13, and nε is 2.2e-12."""
    exact = dict.fromkeys(diagnostics.Certificate._fields, 0.0) | {
        "precision": "float64",
        "num_steps": 10_000,
        "hamiltonian": True,
        "error": None,
    }
    line = str(diagnostics.Certificate(**exact | {"energy": energy})).splitlines()[2]
    assert line.endswith("   " + verdict)


@pytest.mark.long
def test_a_certificate_has_no_number_for_a_momentum_that_the_system_lacks():
    certificate = diagnostics.Certificate(
        **dict.fromkeys(diagnostics.Certificate._fields, 0.0)
        | {"precision": "float64", "momentum": np.nan, "momentum_map": False, "energy": np.nan, "hamiltonian": 1}
        | {"error": None}
    )
    energy, momentum = str(certificate).splitlines()[2:4]
    assert momentum.split(maxsplit=2) == ["momentum", "—", "no momentum map"]
    assert energy.endswith("nan   not a number")
    star = li.systems.group_potential(li.groups.translations(2), [1.0, 1.0], lambda q: q[0, 2] ** 2 + q[1, 2] ** 4)
    certificate = diagnostics.certify(li.schemes.splitting(star), star.state(velocity=[0.3, 0.35]), 0.05, 10)
    assert "no momentum map" in str(certificate)
    assert diagnostics.certify(Euler(BODY), STATE, 0.05, 4).momentum_map


def test_runge_kutta_has_order_four_and_loses_energy():
    """Against the flow by collocation: halving the step divides the error by 16."""
    step = diagnostics.RungeKutta(BODY)
    exact = flow(BODY, STATE, 1.0, 8)
    ends = [li.integrate(step, STATE, 1.0 / n, n, save_every=n).state for n in (20, 40)]
    coarse, fine = (float(np.linalg.norm(np.asarray(end.q[-1] - exact.q))) for end in ends)
    assert np.log2(coarse / fine) == pytest.approx(4, abs=0.1)
    lost = [abs(float(BODY.energy(jax.tree.map(lambda x: x[-1], end)) / BODY.energy(STATE)) - 1) for end in ends]
    assert lost[0] > 10 * lost[1] > 1e-9  # of order 4 too
    assert 0 < diagnostics.step_cost(step, STATE, 0.05) < 1e-3


def pendulum():
    bob = li.systems.pendulum(1.0, 9.81)
    return bob, bob.state([0.6, 0.0, -0.8], velocity=[0.0, 1.0, 0.0])


def satellite():
    body = li.systems.gravity_gradient([0.6, 0.9, 1.0], li.orbits.kepler(1.0, 1.0, 0.1))
    return body, body.state(angular_velocity=[0.4, 0.3, 1.3], t=0.2)


def damped():
    body = li.systems.torqued_body([1.0, 2.0, 3.0], li.torques.kane_damper(0.1, 0.2))
    return body, body.state(angular_velocity=[0.4, 0.3, 1.3], work=0.0)


def pair():
    m, J, spins = np.array([1.0, 2.0]), np.array([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]]), np.ones((2, 3))
    bodies = li.systems.rigid_bodies(m, J, li.potentials.maccullagh(1.0, m, J))
    return bodies, bodies.state([[0.0, 0.0, 0.0], [5.0, 1.0, 1.0]], velocities=0 * spins, angular_velocities=spins)


def gyro():
    frame = li.systems.kinematics(so3, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), t]))
    return frame, frame.state([1.0, 0.0, 0.0, 0.0], t=0.0)


@pytest.mark.long
@pytest.mark.parametrize("case", [pendulum, satellite, damped, pair, gyro])
def test_runge_kutta_integrates_every_system_with_order_four(case):
    """The vector |q| of a pendulum was normalized as a quaternion: it was wrong by 0.2. Others were errors of JAX."""
    system, state = case()
    step, exact = diagnostics.RungeKutta(system), flow(system, state, 0.8, 16)
    off = []
    for n in (20, 40):
        end = jax.tree.map(lambda x: x[-1], li.integrate(step, state, 0.8 / n, n, save_every=n).state)
        pairs = zip(jax.tree.leaves(end), jax.tree.leaves(exact), strict=True)
        off.append(max(float(jnp.abs(x - y).max(initial=0)) for x, y in pairs))
    assert np.log2(off[0] / off[1]) == pytest.approx(4, abs=0.2)
    assert off[1] < 1e-5
    assert step.system.phase_space.defect(end) < 1e-7
    assert 0 < diagnostics.step_cost(step, state, 0.02) < 1e-2


def test_order_of_explicit_euler_and_its_certificate_shows_every_loss():
    certificate = diagnostics.certify(Euler(BODY), STATE, 0.05, 100)
    assert certificate.order == pytest.approx(1, abs=0.1)
    assert certificate.energy > 1e-2
    assert certificate.constraint > 1e-2
    assert certificate.momentum == 0
    assert certificate.symplectic_defect > 1e-3
    assert certificate.symplectic_order == pytest.approx(2, abs=0.2)
    assert certificate.reversibility > 1e-4
    text = str(certificate)
    assert text.count("not conserved") == 2
    assert "not reversible" in text
    assert "broken as dt^" in text
    assert "order                 0.98   measured 0.98" in text


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in PAPER if "asymmetric-" in name])
def test_certificate_of_the_paper_s_schemes(name):
    step, state, dt = GRID[name]
    c = diagnostics.certify(step, state, dt, 400)
    assert c.energy < 4e-15
    assert c.momentum == 0
    assert c.constraint < 2e-15
    assert c.order == pytest.approx(2, abs=0.01)
    assert c.reversibility < 1e-15
    assert c.converged
    if step.kappa.name == "symplectic":
        assert c.symplectic_defect < 2e-15
        assert c.symplectic_order == np.inf
        assert "exact to round-off" in str(c)
    else:
        assert c.symplectic_order == pytest.approx(3, abs=0.01)
    assert "conserved bit for bit" in str(c)
    assert step.name in str(c)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "order"), [("compose[commuting_8]", 8), ("preprocessed[4]", 4), ("preprocessed[6]", 6)]
)
def test_the_certificate_measures_orders_even_where_the_given_step_is_at_round_off(name, order):
    """And whether the form is kept to round-off, or to which order."""
    [(step, state, dt)] = [rest for key, rest in GRID.items() if f"asymmetric-{name}" in key]
    c = diagnostics.certify(step, state, dt, 50)
    assert c.order == pytest.approx(order, abs=0.3)
    assert c.symplectic_order == (np.inf if "compose" in name else pytest.approx(order + 1, abs=0.2))
    assert c.energy < 4e-15


@pytest.mark.long
@pytest.mark.parametrize("scale", [1e-20, 1e-4, 1e20])
def test_verdicts_do_not_depend_on_units(scale):
    """The same body in other units of mass, and its clock run backwards: the same certificate."""
    for kappa, form in ((li.maps.kappa_symplectic, np.inf), (li.maps.kappa_cayley, pytest.approx(3, abs=0.02))):
        body = li.systems.rigid_body(np.array([1.0, 2.0, 3.0]) * scale)
        state = State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.3, -1.0, 2.4]) * scale)
        c = diagnostics.certify(li.schemes.so3_midpoint(body, kappa), state, -0.05, 400)
        assert c.order == pytest.approx(2, abs=0.01)
        assert c.symplectic_order == form
        assert c.reversibility < 1e-15


@pytest.mark.long
def test_verdicts_of_bodies_released_at_rest_are_those_of_any_units():
    """A top whose energy begins at 0, as its axis is horizontal, and a binary whose momenta all begin at 0."""
    verdicts = []
    for mass in (1.0, 2.0**40, 2.0**-40):
        top = li.systems.heavy_top(mass * np.array([1.0, 1.5, 2.0]), mass * np.array([0.0, 0.0, 1.0]))
        start = top.state(so3.exp(jnp.array([np.pi / 2, 0.0, 0.0])), angular_velocity=[0.0, 0.0, 0.0])
        m, J, rest = mass * np.array([1.0, 2.0]), mass * np.array([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]]), np.zeros((2, 3))
        pair = li.systems.rigid_bodies(m, J, li.potentials.maccullagh(1 / mass, m, J))
        apart = pair.state([[0.0, 0.0, 0.0], [5.0, 1.0, 1.0]], velocities=rest, angular_velocities=rest)
        for step, state in ((li.schemes.top_energy_momentum(top), start), (li.schemes.splitting(pair), apart)):
            verdicts.append(str(diagnostics.certify(step, state, 0.02, 50)))
    assert verdicts[2:4] == verdicts[4:] == verdicts[:2]  # to the last digit: the units are powers of 2
    assert "conserved to round-off" in verdicts[0].splitlines()[2]  # the energy
    momentum, _, form, back = verdicts[1].splitlines()[3:7]
    assert "conserved to round-off" in momentum
    assert "exact to round-off" in form
    assert "reversible to round-off" in back


@pytest.mark.long
def test_series_start_at_zero_and_show_a_planted_error():
    step = li.schemes.so3_midpoint(BODY)
    made = jax.jit(lambda z: li.integrate(step, z, 0.1, 20))(STATE)
    run = jax.tree.map(np.array, made)
    run.state.q[7] *= 1.001
    run.state.p[9, 1] += 1e-3
    run = li.Run.of(step, run)
    for series, at in ((run.energy_error, 7), (run.constraint_error, 7), (run.momentum_error, 9)):
        error = np.abs(series()).reshape(21, -1).max(axis=1)
        assert error[0] < 4e-16
        assert error[at] > 1e-4
        assert error[at - 1] < 2e-15


@pytest.mark.long
def test_a_certificate_states_where_the_order_of_the_scheme_does_not_show():
    """A fast top, whose errors fall as dt^10 until round-off, where those of small steps fall as dt⁶; a slower one."""
    [(fast, state, _)] = [x for name, x in li.systems._heavy_top.examples().items() if name == "lagrange"]
    found = diagnostics.certify(li.schemes.nystrom(fast, 6), state, 0.05, 8)
    assert found.order > 8
    assert "the scheme's 6 does not show near this dt" in str(found)
    slow = li.systems.heavy_top([1.0, 2.0, 2.5], [0.0, 0.0, 1.0])
    found = diagnostics.certify(li.schemes.nystrom(slow, 6), slow.state(angular_velocity=[1.0, 1.0, 5.0]), 0.05, 8)
    assert abs(found.order - 6) < 0.1  # observed 6.02
    assert "does not show" not in str(found)
