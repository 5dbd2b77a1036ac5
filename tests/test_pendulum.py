"""The claims of the introduction on the spherical pendulum (Section 1.1), each with its refutation, and row 1.6."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

import lieint_jax as li
from lieint_jax.diagnostics import constraint_error, energy_error, flow, linearization, momentum_error
from lieint_jax.systems.pendulum import Uniform
from lieint_jax.types import State

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


def start(bob):
    return bob.state(Q, velocity=V)


@jax.jit
def _run(step, state):
    run = li.integrate(step, state, 0.1, 1000)
    errors = [f(step.system, run) for f in (energy_error, momentum_error, constraint_error)]
    return [jnp.abs(e).max() for e in errors], run.info.converged.all()


@jax.jit
def _defect(step, state, dt):
    space, L = step.system.phase_space, linearization(step, state, dt)
    return jnp.abs(L.T @ space.omega(step(state, dt)[0]) @ L - space.omega(state)).max()


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("field", FIELDS)
def test_claims_1_and_2_constraints_momentum_and_energy(field, normalised):
    """Energy for at most quadratic g; the normalised rule keeps it for linear g only."""
    step = li.schemes.sphere_midpoint(BOBS[field], normalised)
    (energy, momentum, constraint), converged = _run(step, start(BOBS[field]))
    assert converged
    assert constraint < 2e-12  # floor 3e-13: rounding adds up over 1000 steps
    assert momentum < 4e-14  # floor 7e-15
    if field == "linear" or (field == "quadratic" and not normalised):
        assert energy < 4e-14  # floor 8e-15
    else:
        assert 1e-5 < energy < 1e-2


@pytest.mark.parametrize("field", ["linear", "cubic"])
def test_claim_3_the_plain_rule_is_not_symplectic_the_normalised_one_is(field):
    bob = BOBS[field]
    plain, normalised = (li.schemes.sphere_midpoint(bob, normalised) for normalised in (False, True))
    assert _defect(normalised, start(bob), 0.1) < 2e-15  # floor 3e-16
    coarse, fine = (float(_defect(plain, start(bob), dt)) for dt in (0.1, 0.05))
    assert coarse > 1e-5
    assert np.log2(coarse / fine) == pytest.approx(3, abs=0.1)


def test_1_6_as_printed_does_not_keep_energy():
    """∇H(½(z_n + z_n)), an explicit gradient, for ∇H(½(z_n + z_{n+1})): of first order, and energy is lost."""
    m, dt, grad = 1.5, 0.1, -2 * AXIS

    def one(q, pi, printed):
        def residual(x):
            q1, pi1 = x[:3], x[3:]
            r, p = (q + q1) / 2, pi if printed else (pi + pi1) / 2
            return np.concatenate([q1 - q - dt * np.cross(p / m, r), pi1 - pi + dt * np.cross(r, grad)])

        x = root(residual, np.concatenate([q, pi]), tol=1e-14).x
        return x[:3], x[3:]

    state = start(BOBS["linear"])
    for printed in (False, True):
        q, pi = np.array(state.q), np.array(state.p)
        for _ in range(20):
            q, pi = one(q, pi, printed)
        lost = abs(BOBS["linear"].energy(State(q, pi)) - BOBS["linear"].energy(state))
        assert (lost < 1e-12) != printed
        if not printed:
            ours = li.integrate(li.schemes.sphere_midpoint(BOBS["linear"]), state, dt, 20, 20).state
            np.testing.assert_allclose([ours.q[-1], ours.p[-1]], [q, pi], atol=1e-12)


# Claims 4 and 5: the midpoint rule in spherical coordinates about γ, a local Darboux chart ----------------------------


def spherical_hamiltonian(z):
    """z = (θ, φ, p_θ, p_φ) with γ·q = cos θ, m = 1.5 and g(s) = 2s."""
    return (z[2] ** 2 + z[3] ** 2 / jnp.sin(z[0]) ** 2) / 3 - 2 * jnp.cos(z[0])


J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])


@jax.jit
def spherical_midpoint(z, dt):
    def residual(w):
        return w - z - dt * J @ jax.grad(spherical_hamiltonian)((z + w) / 2)

    w = z
    for _ in range(12):
        w = w - jnp.linalg.solve(jax.jacfwd(residual)(w), residual(w))
    return w, jnp.abs(residual(w)).max()


Z = jnp.array([1.0, 0.3, 0.4, 0.8])


def test_claim_4_in_spherical_coordinates_the_midpoint_rule_is_symplectic_and_keeps_momentum():
    dt, step = 0.1, lambda z: spherical_midpoint(z, 0.1)[0]
    # the converged step's own linearisation, by the implicit function: (1 − ½Δt J H″)⁻¹(1 + ½Δt J H″)
    A = dt / 2 * J @ jax.hessian(spherical_hamiltonian)((Z + step(Z)) / 2)
    L = np.linalg.solve(np.eye(4) - A, np.eye(4) + A)
    assert np.abs(L.T @ J @ L - J).max() < 2e-15
    z = Z
    for _ in range(200):
        z = step(z)
    assert abs(z[3] - Z[3]) < 1e-13


def test_claim_5_in_spherical_coordinates_energy_is_not_kept_even_for_linear_g():
    z, lost = Z, []
    for _ in range(200):
        z, _ = spherical_midpoint(z, 0.1)
        lost.append(abs(spherical_hamiltonian(z) - spherical_hamiltonian(Z)))
    assert 1e-5 < max(lost) < 1e-1


def test_claim_5_the_chart_is_singular_at_the_pole_and_the_sphere_is_not():
    """A swing through the axis: in the chart the momentum's term blows up, on T*S² nothing happens."""
    near = jnp.array([1e-3, 0.0, 1.0, 1e-3])
    assert jnp.linalg.norm(jax.hessian(spherical_hamiltonian)(near)) > 1e5
    through = BOBS["linear"].state(AXIS, velocity=np.array([0.0, 1.0, 0.0]))
    (energy, momentum, constraint), converged = _run(li.schemes.sphere_midpoint(BOBS["linear"]), through)
    assert converged
    assert max(energy, momentum) < 1e-14
    assert constraint < 2e-12


def test_second_order_against_the_flow_and_reversible():
    bob = BOBS["cubic"]
    exact = jax.jit(lambda z: flow(bob, z, 0.8, 16))(start(bob))
    for normalised in (False, True):
        step = jax.jit(li.schemes.sphere_midpoint(bob, normalised).__call__)
        errors = []
        for n in (16, 32):
            state = start(bob)
            for _ in range(n):
                state, _ = step(state, 0.8 / n)
            errors.append(np.abs(state.q - exact.q).max())
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.03)
        back, _ = step(step(start(bob), 0.1)[0], -0.1)
        np.testing.assert_allclose([back.q, back.p], [*start(bob)], atol=4e-15)


def test_the_flow_is_symplectic_for_the_form_of_1_4():
    """The exact flow preserves the frame form, so the form is the right one; with its blocks exchanged it would not."""
    bob = BOBS["cubic"]
    state, space = start(bob), bob.phase_space

    def push(delta):
        return flow(bob, space.perturb(state, delta), 1.0, 5)

    end, tangents = push(jnp.zeros(4)), jax.jacfwd(push)(jnp.zeros(4))
    L = jax.vmap(lambda t: space.trivialise(end, t), in_axes=-1, out_axes=-1)(tangents)
    omega = np.array(space.omega(state))
    assert np.abs(L.T @ omega @ L - omega).max() < 1e-13
    wrong = omega[[2, 3, 0, 1]]
    assert np.abs(L.T @ wrong @ L - wrong).max() > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_frame_form_is_q_dot_the_cross_products(seed):
    """ω(δ₁, δ₂) = q·(δq₁ × δπ₂ + δπ₁ × δq₂) for tangent vectors, and J of (1.4) is its inverse on them."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=3)
    q /= np.linalg.norm(q)
    bob = BOBS["linear"]
    state = bob.state(q, velocity=np.cross(q, rng.normal(size=3)))
    space = bob.phase_space
    T = jax.jacfwd(lambda d: space.perturb(state, d))(jnp.zeros(4))
    dq, dp = np.array(T.q).T, np.array(T.p).T
    form = [[q @ (np.cross(dq[i], dp[j]) + np.cross(dp[i], dq[j])) for j in range(4)] for i in range(4)]
    np.testing.assert_allclose(form, space.omega(state), atol=2e-15)
    field = space.trivialise(state, bob.vector_field(state))
    slope = jax.grad(lambda d: bob.energy(space.perturb(state, d)))(jnp.zeros(4))
    np.testing.assert_allclose(space.omega(state).T @ field, slope, atol=1e-14)  # ω(X_H, ·) = dH


@pytest.mark.parametrize("normalised", [False, True])
def test_gradients_through_a_step(normalised):
    """By the implicit function, with respect to m, mG, γ (leaves of the step) and Δt: against differences, by a jvp."""

    def end(x):
        bob = li.systems.Pendulum(x[0], Uniform(x[1]), x[2:5])
        return li.schemes.sphere_midpoint(bob, normalised)(start(BOBS["linear"]), x[5])[0]

    x, direction = jnp.array([1.5, 2.0, *AXIS, 0.1]), jnp.array([0.3, -0.5, 0.2, 0.7, 0.1, 0.2])
    h, end = 1e-4, jax.jit(end)
    _, slope = jax.jit(lambda: jax.jvp(end, (x,), (direction,)))()
    for ours, ahead, behind in zip(slope, end(x + h * direction), end(x - h * direction), strict=True):
        np.testing.assert_allclose(ours, (ahead - behind) / (2 * h), atol=1e-7)
        assert np.abs(ours).max() > 1e-2


def test_float32_is_kept():
    with jax.enable_x64(False):
        bob = li.systems.pendulum(1.5, 2.0)
        state = bob.state([0.6, 0.0, -0.8], velocity=[0.0, 0.7, 0.0])
        step, energy = jax.jit(li.schemes.sphere_midpoint(bob, True).__call__), bob.energy(state)
        for _ in range(50):
            state, info = step(state, 0.1)
            assert info.converged
        assert state.q.dtype == state.p.dtype == info.residual.dtype == jnp.float32
        assert abs(bob.energy(state) - energy) < 2e-5


def test_errors():
    bob = BOBS["linear"]
    for make, message in (
        (lambda: li.systems.pendulum(-1.0, 1.0), "mass must be positive"),
        (lambda: li.systems.pendulum(1.0, 1.0, [0, 0, 2]), "axis must be a unit vector"),
        (lambda: li.systems.pendulum([1.0], 1.0), "mass must have shape"),
        (lambda: bob.state([1.0, 0], velocity=[0, 0, 1]), "direction must have shape"),
        (lambda: bob.state([1.0, 0, 0], velocity=[0, 0, jnp.nan]), "velocity must be finite"),
        (lambda: li.schemes.top_energy_momentum(bob), "rigid bodies in a potential with an axis"),
        (lambda: li.schemes.sphere_midpoint(bob, iterations=0), "iterations must be an integer"),
        (lambda: bob.state([1.0, 1, 0], velocity=[0, 0, 1]), "direction must be a unit vector"),
        (lambda: bob.state([1.0, 0, 0], velocity=[1, 0, 1]), "orthogonal to q"),
        (lambda: bob.state([1.0, 0, 0]), "exactly one of velocity, momentum; got none"),
        (lambda: bob.check(State(jnp.array([1.0, 0, 0]), jnp.array([1.0, 0, 0]))), "made|make it"),
        (lambda: li.schemes.sphere_midpoint(li.systems.rigid_body([1.0, 2, 3])), "pendulums"),
        (lambda: li.schemes.sphere_midpoint(bob).check(start(bob), 50.0), "does not converge"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
