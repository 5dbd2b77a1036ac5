"""The claims of the introduction on the spherical pendulum (Section 1.1), each with its refutation, and row 1.6."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated import state_after
from scipy.optimize import root
from sphere_chart import SphericalChart, sphere_chart

import lieint_jax as li
from lieint_jax.core import State
from lieint_jax.diagnostics import constraint_error, energy_error, flow, momentum_error, symplectic_defect

pytestmark = pytest.mark.long

AXIS = np.array([0.6, 0.0, -0.8])
Q = np.array([0.48, 0.6, -0.64])
V = np.cross(Q, [0.9, -0.3, 0.5])
FIELDS = {"linear": (0.0, 0.0), "quadratic": (-1.0, 0.0), "cubic": (0.0, 1.0)}


def field(b, c, s):
    return 2 * s + b * s**2 + c * s**3


BOBS = {  # their coefficients are leaves, so all of them share compilations
    name: li.systems.pendulum(1.5, jax.tree_util.Partial(field, *map(jnp.array, coefficients)), AXIS)
    for name, coefficients in FIELDS.items()
}


@functools.cache
def start():
    """Of every bob, which differ in their fields only."""
    with jax.ensure_compile_time_eval():  # it may be asked for first inside jit
        return jax.device_get(jax.jit(lambda: BOBS["linear"].state(Q, velocity=V))())


@jax.jit
def _run(step, state, dt):
    trajectory = li.integrate(step, state, dt, 1000)
    return trajectory, [f(step.system, trajectory) for f in (energy_error, momentum_error, constraint_error)]


def run(step, state, dt=0.1):
    """1000 steps, and the series of their errors: one program for all bobs, states and step sizes."""
    return jax.device_get(_run(step, jax.tree.map(np.asarray, state), dt))


_defect = jax.jit(symplectic_defect)


@pytest.mark.quick
@pytest.mark.paper("1.1: (1.3), (1.5)", "the pendulum, and its momentum about γ", "systems/_pendulum.py")
@pytest.mark.slow
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("field", FIELDS)
def test_claims_1_and_2_constraints_momentum_and_energy(field, normalized):
    """Energy for at most quadratic g; the normalized rule keeps it for linear g only."""
    step = li.schemes.sphere_midpoint(BOBS[field], normalized)
    trajectory, errors = run(step, start())
    energy, momentum, constraint = (np.abs(e).max() for e in errors)
    assert trajectory.info.converged.all()
    assert constraint < 2e-12  # floor 3e-13: rounding adds up over 1000 steps
    assert momentum < 4e-14  # floor 7e-15
    if field == "linear" or (field == "quadratic" and not normalized):
        assert energy < 4e-14  # floor 8e-15
    else:
        assert 1e-5 < energy < 1e-2


@pytest.mark.paper("1.1: claim 3", "not symplectic; normalized it is", "schemes/_sphere_midpoint.py")
@pytest.mark.parametrize("field", ["linear", "cubic"])
def test_claim_3_the_plain_rule_is_not_symplectic_the_normalized_one_is(field):
    bob = BOBS[field]
    plain, normalized = (li.schemes.sphere_midpoint(bob, normalized, iterations=4) for normalized in (False, True))
    assert _defect(normalized, start(), 0.1) < 2e-15  # floor 3e-16
    coarse, fine = (float(_defect(plain, start(), dt)) for dt in (0.1, 0.05))
    assert coarse > 1e-5
    assert np.log2(coarse / fine) == pytest.approx(3, abs=0.1)


@pytest.mark.paper("1.1: (1.6), claims 1, 2", "the midpoint rule on T*S²", "schemes/_sphere_midpoint.py")
def test_1_6_as_printed_does_not_conserve_energy():
    """∇H(½(z_n + z_n)), an explicit gradient, for ∇H(½(z_n + z_{n+1})): of first order, and energy is lost."""
    m, dt, grad = 1.5, 0.1, -2 * AXIS

    def step_by_root(q, pi, printed):
        def residual(x):
            q1, pi1 = x[:3], x[3:]
            r, p = (q + q1) / 2, pi if printed else (pi + pi1) / 2
            return np.concatenate([q1 - q - dt * np.cross(p / m, r), pi1 - pi + dt * np.cross(r, grad)])

        x = root(residual, np.concatenate([q, pi]), tol=1e-14).x
        return x[:3], x[3:]

    ours, _ = run(li.schemes.sphere_midpoint(BOBS["linear"]), start(), dt)
    energy = jax.jit(BOBS["linear"].energy)
    for printed in (False, True):
        q, pi = start()[:2]
        for _ in range(20):
            q, pi = step_by_root(q, pi, printed)
        lost = abs(float(energy(State(q, pi))) - float(energy(start())))
        assert (lost < 1e-12) != printed
        if not printed:
            np.testing.assert_allclose(state_after(ours, 20)[:2], [q, pi], rtol=0, atol=1e-12)


# Claims 4 and 5: the midpoint rule in spherical coordinates about γ, a local Darboux chart ----------------------------


CHART = SphericalChart(jnp.array(AXIS))
J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
Z = np.array([1.0, 0.3, 0.4, 0.8])


@functools.cache
def in_the_chart():
    """200 steps: the run, the errors of energy and momentum, the defect of the form, and the chart's derivative."""
    bob = BOBS["linear"]
    step = sphere_chart(bob, AXIS)

    @jax.jit
    def steps(z):
        state = CHART.state(z)
        tangents = jax.jacfwd(CHART.state)(z)
        slope = jax.vmap(lambda t: bob.phase_space.trivialize(state, t), in_axes=-1, out_axes=-1)(tangents)
        run = li.integrate(step, state, 0.1, 200)
        defect = li.diagnostics.symplectic_defect(step, state, 0.1)
        return run, energy_error(bob, run), momentum_error(bob, run), defect, slope, CHART.coordinates(state)

    return jax.device_get(steps(jnp.array(Z)))


def test_the_spherical_chart_is_one_of_darboux():
    """The form of T*S² is the constant (1.2) in it; p_φ is γ·π; the coordinates of a state lead back to it."""
    *_, slope, back = in_the_chart()
    omega = np.asarray(BOBS["linear"].phase_space.omega(start()))
    assert np.abs(slope.T @ omega @ slope - J).max() < 2e-15
    np.testing.assert_allclose(back, Z, rtol=0, atol=4e-15)
    assert CHART.state(jnp.array(Z)).p @ AXIS == pytest.approx(Z[3], abs=1e-15)


@pytest.mark.paper("1.1: claim 4", "spherical coordinates: form and momentum", "tests/lib/sphere_chart.py")
def test_claim_4_in_spherical_coordinates_the_midpoint_rule_is_symplectic_and_conserves_momentum():
    """The form of T*S² itself, by autodiff of the step on the sphere; γ·π; and the constraints."""
    trajectory, _, momentum, defect, *_ = in_the_chart()
    assert trajectory.info.converged.all()
    assert defect < 4e-15
    assert np.abs(momentum).max() < 1e-13
    assert np.abs(jax.vmap(BOBS["linear"].phase_space.defect)(trajectory.state)).max() < 2e-15


def test_claim_4_the_step_is_the_midpoint_rule_in_the_coordinates():
    """z₁ − z₀ = Δt J∇H(½(z₀ + z₁)), H taken through the chart by autodiff."""
    trajectory = in_the_chart()[0]
    hamiltonian = lambda z: BOBS["linear"].energy(CHART.state(z))  # noqa: E731
    zs = [CHART.coordinates(jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), trajectory.state)) for k in (0, 1)]
    change = 0.1 * J @ jax.jit(jax.grad(hamiltonian))((zs[0] + zs[1]) / 2)
    np.testing.assert_allclose(zs[1] - zs[0], change, rtol=0, atol=4e-15)


def test_claim_5_in_spherical_coordinates_energy_is_not_conserved_even_for_linear_g():
    energy = in_the_chart()[1]
    assert 1e-5 < np.abs(energy).max() < 1e-1


def test_claim_4_second_order_and_reversible_about_any_axis():
    """Also about another axis than γ, where p_φ is not conserved: still symplectic."""
    bob, state = BOBS["linear"], CHART.state(jnp.array(Z))
    other = np.array([0.6, 0.0, 0.8])
    found = li.diagnostics.certify(sphere_chart(bob, other), state, 0.05, 20)
    assert found.order == pytest.approx(2, abs=0.05)
    assert found.symplectic_defect < 8e-15
    assert found.reversibility < 4e-15
    assert found.momentum > 1e-6
    assert found.converged


@pytest.mark.quick
def test_the_step_in_the_chart_follows_the_vector_field():
    """By the central difference of two steps."""
    bob, h = BOBS["cubic"], 1e-3
    step = jax.jit(lambda state, dt: sphere_chart(bob, AXIS)(state, dt)[0])
    ahead, behind = (step(start(), dt) for dt in (h, -h))
    field = bob.vector_field(start())
    for a, b, rate in zip(ahead[:2], behind[:2], field[:2], strict=True):
        np.testing.assert_allclose((a - b) / (2 * h), rate, rtol=0, atol=1e-5)


def test_claim_5_at_the_pole_the_step_in_the_chart_is_flagged():
    """Elsewhere it is not, be it at rest; a NaN never comes without the flag."""
    bob = BOBS["linear"]
    step = jax.jit(sphere_chart(bob, AXIS))
    assert step(State(jnp.array(Q), jnp.zeros(3)), 0.1)[1].converged
    for z in ([1e-7, 0.3, 0.1, 0.0], [np.pi - 1e-7, 0.3, 0.1, 0.0], [0.02, 0.0, -1.0, 0.0], [1e-3, 0.0, 1.0, 1e-3]):
        after, info = step(CHART.state(jnp.array(z)), 0.1)
        assert not info.converged
    after, info = step(State(jnp.array(AXIS), jnp.zeros(3)), 0.1)
    assert not info.converged
    assert np.isfinite(after.q).all()
    with pytest.raises(ValueError, match=r"the chart is singular.*or sphere_midpoint"):
        sphere_chart(bob, AXIS).check(State(jnp.array(AXIS), jnp.zeros(3)), 0.1)


@pytest.mark.paper("1.1: claim 5", "spherical coordinates: energy, the pole", "tests/lib/sphere_chart.py")
def test_claim_5_the_chart_is_singular_at_the_pole_and_the_sphere_is_not():
    """A swing through the axis: in the chart the momentum's term blows up, on T*S² nothing happens."""
    near = np.array([1e-3, 0.0, 1.0, 1e-3])
    assert np.linalg.norm(jax.jit(jax.hessian(lambda z: BOBS["linear"].energy(CHART.state(z))))(near)) > 1e5
    through = State(AXIS, 1.5 * np.cross(AXIS, [0.0, 1.0, 0.0]))
    trajectory, errors = run(li.schemes.sphere_midpoint(BOBS["linear"]), through)
    energy, momentum, constraint = (np.abs(e).max() for e in errors)
    assert trajectory.info.converged.all()
    assert max(energy, momentum) < 1e-14
    assert constraint < 2e-12


@pytest.mark.parametrize("make", [li.schemes.sphere_midpoint, sphere_chart])
def test_single_precision_in_any_unit_of_mass(make):
    """The squares of these momenta leave the range of float32: flags and motion are those of m = 1."""

    @jax.jit
    def end(mass, dt):
        bob = li.systems.pendulum(mass, jnp.float32(2.0))
        state = State(jnp.float32([0.6, 0.0, -0.8]), mass * jnp.float32([0.72, -0.94, 0.54]))
        (q, p, *_), info = make(bob)(state, dt)
        return q, p / mass, info.converged

    for dt, converges in ((0.1, True), (2.5, False)):
        q, p, converged = end(jnp.float32(1), dt)
        assert converged == converges
        for mass in (1e-20, 1e20):
            there = end(jnp.float32(mass), dt)
            assert there[2] == converges
            if converges:  # seen: 3e-8
                np.testing.assert_allclose(np.hstack(there[:2]), np.hstack([q, p]), rtol=0, atol=3e-7)


def test_a_step_back_undoes_a_step():
    for normalized in (False, True):
        step = li.schemes.sphere_midpoint(BOBS["cubic"], normalized)
        there = state_after(run(step, start(), 0.1)[0], 1)
        np.testing.assert_allclose(state_after(run(step, there, -0.1)[0], 1)[:2], start()[:2], rtol=0, atol=4e-15)


@pytest.mark.paper("1.1: (1.4)", "the form of T*S²", "phase_spaces/_sphere.py")
def test_the_flow_is_symplectic_for_the_form_of_1_4():
    """The exact flow preserves the frame form, so the form is the right one; with its blocks exchanged it would not."""
    bob = BOBS["cubic"]
    space = bob.phase_space

    @jax.jit
    def linearized():
        push = lambda delta: flow(bob, space.perturb(start(), delta), 1.0, 5)  # noqa: E731
        end, tangents = push(jnp.zeros(4)), jax.jacfwd(push)(jnp.zeros(4))
        return jax.vmap(lambda t: space.trivialize(end, t), in_axes=-1, out_axes=-1)(tangents)

    L, omega = np.asarray(linearized()), np.asarray(space.omega(start()))
    assert np.abs(L.T @ omega @ L - omega).max() < 1e-13
    wrong = omega[[2, 3, 0, 1]]
    assert np.abs(L.T @ wrong @ L - wrong).max() > 0.1


@jax.jit
def _in_the_frame(state):
    """At a state: a basis of tangent vectors, ω, the vector field, and dH."""
    bob, zero = BOBS["linear"], jnp.zeros(4)
    space = bob.phase_space
    tangents = jax.jacfwd(lambda d: space.perturb(state, d))(zero)
    slope = jax.grad(lambda d: bob.energy(space.perturb(state, d)))(zero)
    return tangents, space.omega(state), space.trivialize(state, bob.vector_field(state)), slope


@pytest.mark.parametrize("seed", range(3))
def test_the_frame_form_is_q_dot_the_cross_products(seed):
    """ω(δ₁, δ₂) = q·(δq₁ × δπ₂ + δπ₁ × δq₂) for tangent vectors, and J of (1.4) is its inverse on them."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=3)
    q /= np.linalg.norm(q)
    p = 1.5 * np.cross(q, np.cross(q, rng.normal(size=3)))
    tangents, omega, field, slope = jax.device_get(_in_the_frame(State(q, p)))
    dq, dp = tangents.q.T, tangents.p.T
    form = [[q @ (np.cross(dq[i], dp[j]) + np.cross(dp[i], dq[j])) for j in range(4)] for i in range(4)]
    np.testing.assert_allclose(form, omega, rtol=0, atol=2e-15)
    np.testing.assert_allclose(omega.T @ field, slope, rtol=0, atol=1e-14)  # ω(X_H, ·) = dH


def test_the_closed_form_of_the_pendulum_has_three_known_limits():
    """Three limits of it, by other formulas.

    A conical pendulum goes round at √(G/cos θ), and its angle swings about θ with the frequency √(G(1 + 3cos²θ)/cos θ);
    a swing in a plane has twice the time from lowest to lowest point, by the arithmetic-geometric mean.
    """
    G, theta = 9.80665, np.arccos(0.6)
    rate = np.sqrt(G / 0.6)
    bob = li.systems.pendulum(1.0, G, [0.0, 0.0, -1.0])

    def closed(speed):
        state = bob.state([0.8, 0.0, -0.6], velocity=[0.0, speed, 0.0])
        return li.systems.lagrange_motion(*li.systems.pendulum_as_top(bob, state))

    found = closed(0.8 * rate * 1.0001)
    assert float(found.precession_rate) == pytest.approx(rate, rel=1e-3)
    assert float(found.nutation_period) == pytest.approx(2 * np.pi / np.sqrt(G * (1 + 3 * 0.36) / 0.6), rel=1e-3)
    np.testing.assert_allclose(found.inclination, np.pi - theta, rtol=0, atol=1e-3)  # from upward
    x, y = 1.0, np.cos(theta / 2)
    for _ in range(6):
        x, y = (x + y) / 2, np.sqrt(x * y)
    assert float(closed(1e-4).nutation_period) == pytest.approx(np.pi / x / np.sqrt(G), rel=1e-6)


def test_the_pendulum_as_a_top_has_its_energy_and_momentum_and_no_spin():
    bob = li.systems.pendulum(2.0, 9.80665, [0.6, 0.0, 0.8])
    rng = np.random.default_rng(3)
    q, v = rng.normal(size=(2, 5, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    v -= q * np.sum(q * v, axis=1, keepdims=True)

    @jax.jit
    @jax.vmap
    def both(q, v):
        state = bob.state(q, velocity=v)
        top, as_top = li.systems.pendulum_as_top(bob, state)
        found = [(x.energy(z), x.momentum(z)) for x, z in ((bob, state), (top, as_top))]
        return found, top.body_momentum(as_top)

    ((energy, momentum), (of_top, momentum_of_top)), Pi = jax.device_get(both(q, v))
    np.testing.assert_allclose(of_top, energy, rtol=0, atol=1e-13)
    np.testing.assert_allclose(Pi[:, 2], 0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(momentum_of_top, -momentum, rtol=0, atol=1e-14)
