"""The exact flow against Taylor series at 50 digits and closed forms; invariants, group law, derivatives."""

import itertools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax._numerics import elliptic
from lieint_jax.groups import so3
from lieint_jax.schemes import exact
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

Q = so3.normalise(jnp.array([1.0, 2, -1, 0.5]))
TURN = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
solve = jax.jit(lambda J, state, t: RigidBody(J).solution(state, t))
derivative = jax.jit(jax.jacfwd(lambda J, state, t: RigidBody(J).solution(state, t).q, argnums=(0, 1, 2)))
flow_derivative = jax.jit(
    jax.jacfwd(lambda J, state, t: diagnostics.flow(RigidBody(J), state, t, 12).q, argnums=(0, 1, 2))
)


def setting(moments, Omega):
    J = jnp.array(moments, float)
    return J, RigidBody(J).state(Q, angular_velocity=jnp.array(Omega, float))


def difference(a, b):
    return float(jnp.max(jnp.abs(a - b)))


def reference(J, state, t, order=48):
    """The attitude at t at 50 digits: Taylor series of Π̇ = Π × Ω and q̇ = ½qΩ, for principal moments J."""
    with mpmath.workdps(50):
        dot = mpmath.fdot
        J, q, p = ([mpmath.mpf(float(x)) for x in v] for v in (J, state.q, state.p))
        q = [x / mpmath.sqrt(dot(q, q)) for x in q]
        Omega = [x / j for x, j in zip(body_momentum(q, p), J, strict=True)]
        k = [(J[(i + 1) % 3] - J[(i + 2) % 3]) / J[i] for i in range(3)]
        steps = int(mpmath.ceil(abs(t) * mpmath.sqrt(dot(p, p)) / min(J) / 0.7))
        h = mpmath.mpf(float(t)) / steps
        for _ in range(steps):
            W, Z = [[x] for x in Omega], [[x] for x in q]
            for n in range(order):
                x, y, z = reverse = [w[::-1] for w in W]
                a, b, c, d = Z
                new_W = [k[i] * dot(W[(i + 1) % 3], reverse[(i + 2) % 3]) for i in range(3)]
                new_Z = [
                    -dot(b, x) - dot(c, y) - dot(d, z),
                    dot(a, x) + dot(c, z) - dot(d, y),
                    dot(a, y) - dot(b, z) + dot(d, x),
                    dot(a, z) + dot(b, y) - dot(c, x),
                ]
                for series, value in zip(W + Z, new_W + [v / 2 for v in new_Z], strict=True):
                    series.append(value * h / (n + 1))
            Omega, q = [mpmath.fsum(w) for w in W], [mpmath.fsum(c) for c in Z]
        return np.array([float(x) for x in q])


def body_momentum(q, p):
    """Λᵀπ in mpmath."""
    w, x, y, z = q
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    return [mpmath.fdot(row, p) for row in rows]


@pytest.mark.parametrize(
    ("moments", "Omega", "t"),
    [
        ([1, 2, 3], [0.2, 0.1, 1], 100.0),
        ([0.45, 0.6, 0.8], [-0.17, 0.96, -0.2], -60.0),
        ([3, 1, 2.5], [0.6, 0.5, 0.6], 60.0),
        ([1, 1.001, 5], [0.1, 1, 1e-6], 60.0),
        ([1, 1, 2], [1, 0, 1e-3], 40.0),
    ],
)
def test_long_times_against_50_digits(moments, Omega, t):
    J, state = setting(moments, Omega)
    assert difference(solve(J, state, t).q, reference(J, state, t)) < 1e-13  # floor 2e-14


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, -1e-9, -1e-3])
def test_near_the_separatrix(off):
    """On it (1/J₁ − 1/J₂)Π₁² = (1/J₂ − 1/J₃)Π₃². The last bits of the state allow an error of eps·exp(λt)."""
    J = jnp.array([1.0, 2.0, 3.0])
    state = State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.3, 0.8, 0.3 * 3**0.5 * (1 + off)]))
    for t in (12.0, -12.0) if off in (0.0, 1e-9) else (12.0,):
        sensitivity = 1 + float(jnp.abs(derivative(J, state, t)[1].p).max())
        assert difference(solve(J, state, t).q, reference(J, state, t)) < 2e-15 * sensitivity


@pytest.mark.parametrize(
    "moments", [*itertools.permutations([1.0, 2.0, 3.0]), [1, 1, 2], [2, 1, 1], [1, 2, 1], [1, 1, 1]]
)
def test_value_and_derivatives_for_every_ordering_and_symmetry(moments):
    """Against collocation of the vector field, in q, π, J and t; motions about every axis, permanent rotations too."""
    for Omega in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.8, 0.1, 0.2], [0.1, 0.2, 0.9], [0.01, 1, 0]):
        J, state = setting(moments, Omega)
        assert difference(solve(J, state, 4.0).q, diagnostics_flow(J, state, 4.0)) < 2e-14  # floor 3e-15
        found, expected = derivative(J, state, 4.0), flow_derivative(J, state, 4.0)
        for a, b in zip((found[0], found[1].p, found[2]), (expected[0], expected[1].p, expected[2]), strict=True):
            assert difference(a, b) < 5e-14 * (1 + float(jnp.abs(b).max()))
        tangent = jnp.eye(4) - jnp.outer(Q, Q)
        assert difference(found[1].q @ tangent, expected[1].q @ tangent) < 1e-12


diagnostics_flow = jax.jit(lambda J, state, t: diagnostics.flow(RigidBody(J), state, t, 12).q)


def test_symmetric_top_and_sphere_in_closed_form():
    """Λ(t) = exp(tπ̂/J₁) Λ exp(t(1/J₃ − 1/J₁)Π₃ ê₃)."""
    for moments in ([1.0, 1.0, 2.0], [2.0, 2.0, 1.0], [1.5, 1.5, 1.5]):
        J, state = setting(moments, [0.3, 0.4, 0.8])
        for t in (0.01, -7.0, 90.0):
            spin = t * (1 / J[2] - 1 / J[0]) * RigidBody(J).body_momentum(state)[2]
            q = so3.multiply(so3.exp(t * state.p / J[0]), so3.multiply(Q, so3.exp(jnp.array([0, 0, spin]))))
            assert difference(solve(J, state, t).q, q) < 5e-14  # floor 1e-14


def test_half_a_turn_of_the_intermediate_axis_takes_two_quarter_periods():
    """From Π₂ = 0 the body momentum has Π₃ → 0 … and Π₁, Π₂ change sign after 2K/λ."""
    J = jnp.array([1.0, 2.0, 3.0])
    Pi = jnp.array([0.1, 0.0, 1.0])  # about the third axis: λ² = (b₁ − b₃)(b₂ − b₃)Π₃²
    low, high = 1 - 1 / 2, 1 / 2 - 1 / 3
    K = elliptic.quarter_period((high * Pi[2] ** 2 - low * Pi[0] ** 2) / (high * Pi[2] ** 2))
    quarter = K / jnp.sqrt((low + high) * high) / Pi[2]
    body = RigidBody(J)
    state = body.state(Q, body_momentum=Pi)
    flipped = body.body_momentum(solve(J, state, 2 * quarter))
    assert difference(flipped, Pi * jnp.array([-1, 1, 1])) < 5e-15
    middle = body.body_momentum(solve(J, state, quarter))
    assert abs(float(middle[0])) < 5e-15
    assert float(jnp.abs(middle[1])) == pytest.approx(0.1 * (2 / 3 / (1 / 6)) ** 0.5, rel=1e-13)


@pytest.mark.parametrize("full", [False, True])
def test_invariants_group_law_and_form(full):
    J = jnp.array([1.0, 2.0, 3.0])
    body = RigidBody(TURN @ jnp.diag(J) @ TURN.T if full else J)
    state = body.state(Q, angular_velocity=jnp.array([0.3, 0.6, 0.8]))
    run = li.integrate(exact(body), state, 3.0, 300)
    assert run.info.converged.all()
    assert np.abs(diagnostics.energy_error(body, run)).max() < 1e-13  # floor 4e-15; full 3e-14, half an eps per step
    assert np.abs(diagnostics.momentum_error(body, run)).max() == 0
    assert difference(run.state.q[30], body.solution(state, 90.0).q) < 1e-13
    assert diagnostics.reversibility(exact(body), state, 20.0) < 5e-14
    if not full:
        assert diagnostics.symplectic_defect(exact(body), state, 3.0) < 5e-14
    assert difference(run.state.q[1], diagnostics.flow(body, state, 3.0, 12).q) < 1e-14
    assert abs(float(so3.defect(run.state.q[-1]))) < 1e-15


def test_poinsot():
    """Ω rolls: its end stays on the plane 2H = π·ω, |Π| is constant, for 200 times in one batch."""
    J, state = setting([1, 2, 3], [0.1, 1, 0.2])
    body, times = RigidBody(J), jnp.linspace(-100.0, 100.0, 200)
    states = jax.jit(jax.vmap(body.solution, (None, 0)))(state, times)
    Omega = jax.vmap(body.angular_velocity)(states)
    height = jax.vmap(lambda q, w: so3.Ad(q, w) @ state.p)(states.q, Omega)
    assert np.abs(height - 2 * body.energy(state)).max() < 1e-14
    assert np.abs(jnp.linalg.norm(Omega * J, axis=1) - jnp.linalg.norm(state.p)).max() < 5e-15


def test_gradient_of_a_full_tensor_and_reverse_mode():
    J, state = TURN @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ TURN.T, setting([1, 2, 3], [0.3, 0.6, 0.8])[1]
    end = jax.jit(lambda J, t: RigidBody(J).solution(state, t).q[1])
    by_J, by_t = jax.grad(lambda J, t: RigidBody(J).solution(state, t).q[1], argnums=(0, 1))(J, 4.0)
    E, h = jnp.array([[0.2, 0.5, -0.3], [0.5, 0.1, 0.7], [-0.3, 0.7, 0.4]]), 1e-5
    assert float(jnp.sum(by_J * E)) == pytest.approx(
        float(end(J + h * E, 4.0) - end(J - h * E, 4.0)) / (2 * h), rel=1e-7
    )
    assert float(by_t) == pytest.approx(float(end(J, 4.0 + h) - end(J, 4.0 - h)) / (2 * h), rel=1e-7)


def test_rest_and_single_precision():
    J, state = setting([1, 2, 3], [0, 0, 0])
    assert difference(solve(J, state, 5.0).q, Q) < 3e-16
    of_p = derivative(J, state, 5.0)[1].p
    assert difference(of_p, flow_derivative(J, state, 5.0)[1].p) < 1e-14
    J, state = setting([1, 2, 3], [0.3, 0.6, 0.8])
    q = solve(J.astype("float32"), jax.tree.map(lambda x: x.astype("float32"), state), jnp.float32(20)).q
    assert q.dtype == jnp.float32
    assert difference(q, solve(J, state, 20.0).q) < 2e-5


def test_bad_arguments():
    with pytest.raises(ValueError, match="free rigid bodies"):
        exact("top")
    J, state = setting([1, 2, 3], [0.3, 0.6, 0.8])
    with pytest.raises(ValueError):
        li.integrate(exact(RigidBody(J)), state, float("inf"), 1)
