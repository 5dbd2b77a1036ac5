"""The exact flow against Taylor series at 50 digits and closed forms; invariants, group law, derivatives."""

import itertools
import operator
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import taylor
from free_bodies import Q, moving, rows, turned, with_momentum

from lieint_jax import diagnostics
from lieint_jax._numerics import elliptic
from lieint_jax.core import State
from lieint_jax.groups import so3
from lieint_jax.schemes import exact
from lieint_jax.systems import RigidBody

solve = jax.jit(lambda J, state, t: RigidBody(J).solution(state, t))
derivative = jax.jit(jax.jacfwd(lambda J, state, t: RigidBody(J).solution(state, t).q, argnums=(0, 1, 2)))


def _flow(J, state, t):
    q = diagnostics.flow(RigidBody(J), state, t, 12).q
    return q, q


flow_and_derivative = jax.jit(jax.jacfwd(_flow, argnums=(0, 1, 2), has_aux=True))  # the other way round: (slopes, q)


def setting(moments, Omega):
    return np.array(moments, float), moving(moments, Omega)


def difference(a, b):
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


def reference(J, state, t):
    """The attitude at t in 50 digits, for principal moments J."""
    q = [Fraction(float(x)) for x in state.q]
    size = taylor.sqrt(sum(x * x for x in q))
    q = [x / size for x in q]
    J = [Fraction(float(x)) for x in J]
    p = [Fraction(float(x)) for x in state.p]
    Omega = [sum(map(operator.mul, p, row)) / j for row, j in zip(rows(*q), J, strict=True)]
    speed = np.linalg.norm(state.p) / min(J)

    def rate(y):
        w, a, b, c, x, y, z = y
        return (
            (a * x + b * y + c * z) / -2,
            (w * x + b * z - c * y) / 2,
            (w * y + c * x - a * z) / 2,
            (w * z + a * y - b * x) / 2,
            y * z * ((J[1] - J[2]) / J[0]),
            z * x * ((J[2] - J[0]) / J[1]),
            x * y * ((J[0] - J[1]) / J[2]),
        )

    _, end = taylor.solve(rate if t > 0 else lambda y: [-x for x in rate(y)], q + Omega, [0, abs(t)], 0.7 / speed, 48)
    return np.array(end[:4], float)


@pytest.mark.slow
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
def test_exact_steps_over_long_times_agree_with_50_digits(moments, Omega, t):
    J, state = setting(moments, Omega)
    assert difference(solve(J, state, t).q, reference(J, state, t)) < 1e-13  # floor 2e-14


@pytest.mark.parametrize("moments", [[1, 2, 3], [1, 1.0127, 3.3062]])
def test_rounding_errors_of_short_exact_steps_are_proportional_to_the_step(moments):
    """From q = 1, where the vector part is the change. Observed: 2e-16 of it; as a difference of numbers near 1 it
    would have an error of 5e-17 at every t, 5e-13 of it here."""
    J, state = setting(moments, [0.4, 0.2, 0.9])
    state = state._replace(q=np.array([1.0, 0, 0, 0]))
    for t in (1e-4, -3e-3):
        expected = reference(J, state, t)[1:]
        assert difference(solve(J, state, t).q[1:], expected) < 1e-15 * np.abs(expected).max()


@pytest.mark.long
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, -1e-9, -1e-3])
def test_exact_steps_near_the_separatrix_lose_no_more_digits_than_the_state(off):
    """On it (1/J₁ − 1/J₂)Π₁² = (1/J₂ − 1/J₃)Π₃². The last bits of the state allow an error of eps·exp(λt)."""
    J = np.array([1.0, 2.0, 3.0])
    state = State(np.array([1.0, 0, 0, 0]), np.array([0.3, 0.8, 0.3 * 3**0.5 * (1 + off)]))
    for t in (12.0, -12.0) if off in (0.0, 1e-9) else (12.0,):
        sensitivity = 1 + float(np.abs(derivative(J, state, t)[1].p).max())
        assert difference(solve(J, state, t).q, reference(J, state, t)) < 2e-15 * sensitivity


@pytest.mark.long
@pytest.mark.parametrize(
    "moments", [*itertools.permutations([1.0, 2.0, 3.0]), [1, 1, 2], [2, 1, 1], [1, 2, 1], [1, 1, 1]]
)
def test_exact_steps_have_values_and_derivatives_for_every_ordering_and_symmetry(moments):
    """Against collocation of the vector field, in q, π, J and t; motions about every axis, permanent rotations too."""
    for Omega in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.8, 0.1, 0.2], [0.1, 0.2, 0.9], [0.01, 1, 0]):
        J, state = setting(moments, Omega)
        found, (expected, q) = derivative(J, state, 4.0), flow_and_derivative(J, state, 4.0)
        assert difference(solve(J, state, 4.0).q, q) < 2e-14  # floor 3e-15
        for a, b in zip((found[0], found[1].p, found[2]), (expected[0], expected[1].p, expected[2]), strict=True):
            assert difference(a, b) < 5e-14 * (1 + float(np.abs(b).max()))
        tangent = np.eye(4) - np.outer(Q, Q)
        assert difference(np.asarray(found[1].q) @ tangent, np.asarray(expected[1].q) @ tangent) < 1e-12


def test_the_energy_of_a_motion_beside_the_middle_axis_does_not_change():
    """Π is on it up to rounding, so that sn, cn, dn have no digits when it has left."""
    with pytest.warns(UserWarning, match="break the triangle inequality"):
        body = RigidBody(np.array([0.07633906295784071, 45.741070017808525, 18.44988703572265]))
    q = np.array([-0.048999117852688484, -0.49259766289165824, -0.7402421031971206, 0.4549596219640134])
    start = State(q, np.array([1.534881223472664, 2.9491186194057137, 2.374633295808054]))
    end = solve(body.inertia, start, -11.083617762490181)
    assert difference(body.energy(end), body.energy(start)) < 5e-15 * body.energy(start)  # observed 9e-16


def test_a_tangent_is_the_difference_of_near_motions():
    """In J, π and t at once, after more than a period; against differences of order 4."""

    def end(x):
        return solve(x[:3], State(jnp.array(Q), x[3:6]), x[6]).q

    x, direction = np.array([1.0, 2.0, 3.0, 0.3, 0.8, -0.5, 11.0]), np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2, 0.6])
    tangent = jax.jit(lambda: jax.jvp(end, (x,), (direction,))[1])()
    low2, low, high, high2 = (end(x + shift * direction) for shift in (-2e-3, -1e-3, 1e-3, 2e-3))
    assert difference(tangent, (8 * (high - low) - (high2 - low2)) / 12e-3) < 2e-10  # observed 5e-11


def test_tangents_of_short_steps_keep_all_digits():
    """That of the change of attitude is relatively as exact as that of a step of Runge-Kutta, error (1e-4)⁵."""

    def slope(J, q, Pi):
        Omega = Pi / J
        return so3.multiply(q, jnp.array([0.0, *Omega])) / 2, jnp.cross(Pi, Omega)

    def runge_kutta(J, p, t):
        q, Pi = jnp.array(Q), so3.Ad_star(jnp.array(Q), p)
        k = [slope(J, q, Pi)]
        for c in (t / 2, t / 2, t):
            k.append(slope(J, q + c * k[-1][0], Pi + c * k[-1][1]))
        return t / 6 * (k[0][0] + 2 * k[1][0] + 2 * k[2][0] + k[3][0])

    x = np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.8, -0.5]), 1e-4
    direction = np.array([0.3, -0.2, 0.5]), np.array([0.4, -0.1, 0.2]), 0.0
    expected = jax.jvp(runge_kutta, x, direction)[1]
    found = jax.jit(lambda *x: jax.jvp(lambda J, p, t: solve(J, State(jnp.array(Q), p), t).q, x, direction)[1])(*x)
    assert difference(found, expected) < 1e-15 * np.abs(expected).max()  # observed 1e-16


def test_a_second_derivative_of_a_sphere_is_the_difference_of_first_ones():
    """In directions of J, π and t; against differences of order 4."""

    @jax.jit
    @jax.vmap
    def second(shift):
        return jax.jvp(lambda shift: first(x + shift * other), (shift,), (1.0,))

    def first(x):
        return jax.jvp(lambda x: solve(x[:3], State(jnp.array(Q), x[3:6]), x[6]).q, (x,), (direction,))[1]

    x, direction = np.array([1.0, 1.0, 1.0, 0.3, 0.8, -0.5, 1.7]), np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2, 0.6])
    other, size = np.array([-0.1, 0.4, 0.3, 0.1, 0.5, -0.3, 0.2]), 1e-3
    slopes, seconds = second(size * np.array([-2.0, -1.0, 1.0, 2.0, 0.0]))
    low2, low, high, high2 = slopes[:4]
    assert difference(seconds[4], (8 * (high - low) - (high2 - low2)) / (12 * size)) < 1e-12  # observed 1.2e-13


@pytest.mark.long
@pytest.mark.parametrize("moments", [[1, 2, 3], [1, 1, 2], [1, 2, 2], [1, 1, 1]])
def test_second_derivatives_are_right_for_every_symmetry(moments):
    """Against differences of order 4 of the first ones, in J, π and t."""

    def first(x):
        J, p, t = jnp.split(x, (3, 6))
        return jax.jacfwd(lambda J, p, t: RigidBody(J).solution(State(jnp.array(Q), p), t[0]).q, (0, 1, 2))(J, p, t)

    def rows(x):
        return jnp.concatenate(first(x), axis=1)

    x, step = np.array([*moments, 0.3, 0.8, -0.5, 1.7], float), 1e-3
    second = jax.jit(jax.jacfwd(rows))(x)
    shifted = jax.jit(jax.vmap(lambda shift: jax.vmap(lambda e: rows(x + shift * e), out_axes=-1)(jnp.eye(7))))
    low2, low, high, high2 = shifted(step * np.array([-2.0, -1.0, 1.0, 2.0]))
    assert difference(second, (8 * (high - low) - (high2 - low2)) / (12 * step)) < 2e-10  # observed 2e-11


@jax.jit
def closed_form(J, state, t):
    """exp(tπ̂/J₁) Λ exp(t(1/J₃ − 1/J₁)Π₃ ê₃), for J₁ = J₂."""
    spin = t * (1 / J[2] - 1 / J[0]) * RigidBody(J).body_momentum(state)[2]
    turn = so3.exp(spin * jnp.array([0.0, 0.0, 1.0]))
    return so3.multiply(so3.exp(t * state.p / J[0]), so3.multiply(state.q, turn))


def test_a_symmetric_body_and_a_sphere_move_by_the_elementary_closed_form():
    """Λ(t) = exp(tπ̂/J₁) Λ exp(t(1/J₃ − 1/J₁)Π₃ ê₃)."""
    for moments in ([1.0, 1.0, 2.0], [2.0, 2.0, 1.0], [1.5, 1.5, 1.5]):
        J, state = setting(moments, [0.3, 0.4, 0.8])
        for t in (0.01, -7.0, 90.0):
            assert difference(solve(J, state, t).q, closed_form(J, state, t)) < 5e-14  # floor 1e-14


@pytest.mark.long
def test_half_a_rotation_about_the_middle_axis_lasts_two_quarter_periods():
    """From Π₂ = 0 the body momentum has Π₃ → 0 … and Π₁, Π₂ change sign after 2K/λ."""
    J, Pi = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.0, 1.0])  # about the third axis: λ² = (b₁ − b₃)(b₂ − b₃)Π₃²
    low, high = 1 - 1 / 2, 1 / 2 - 1 / 3
    K = jax.jit(elliptic.quarter_period)((high * Pi[2] ** 2 - low * Pi[0] ** 2) / (high * Pi[2] ** 2))
    quarter = float(K) / np.sqrt((low + high) * high) / Pi[2]
    state = with_momentum(Pi)
    middle, flipped = (np.array(rows(*solve(J, state, t).q)) @ state.p for t in (quarter, 2 * quarter))
    assert difference(flipped, Pi * np.array([-1, 1, 1])) < 5e-15
    assert abs(float(middle[0])) < 5e-15
    assert float(np.abs(middle[1])) == pytest.approx(0.1 * (2 / 3 / (1 / 6)) ** 0.5, rel=1e-13, abs=0)


@jax.jit
def walk(body, state, sizes, again):
    """Steps of these sizes, from `state` and again from it where `again` says so: energies, units and flags."""
    step = exact(body)

    def step_once(now, case):
        size, restart = case
        now = jax.tree.map(lambda start, here: jnp.where(restart, start, here), state, now)
        now, info = step(now, size)
        return now, (now, body.energy(now) - body.energy(state), so3.defect(now.q), info.converged)

    return jax.lax.scan(step_once, state, (sizes, again))[1]


@pytest.mark.long
@pytest.mark.parametrize("full", [False, True])
def test_the_exact_flow_has_its_invariants_group_law_and_form(full):
    J = turned([1.0, 2.0, 3.0]) if full else jnp.array([1.0, 2.0, 3.0])
    state = moving(J)
    sizes, again = np.array([3.0] * 300 + [20.0, -20.0]), np.arange(302) == 300
    after, energy, unit, converged = walk(RigidBody(J), state, sizes, again)
    assert converged.all()
    # the rounding of a full tensor's axes depends on the processor, and is the same at every step: it adds up
    assert np.abs(energy[:300]).max() < (4e-13 if full else 3e-14)  # observed 7e-15; full 3e-14 to 1.1e-13
    assert np.abs(after.p - state.p).max() == 0
    assert difference(after.q[29], solve(J, state, 90.0).q) < (1e-12 if full else 1e-13)  # 2e-14; full 1.4 to 3.2e-13
    assert difference(after.q[301], Q) < 5e-14
    if not full:
        assert defect(RigidBody(J), state, 3.0) < 5e-14
    assert difference(after.q[0], flow_of_body(RigidBody(J), state, 3.0)) < 1e-14
    assert abs(float(unit[299])) < 1e-15


flow_of_body = jax.jit(lambda body, state, t: diagnostics.flow(body, state, t, 12).q)
defect = jax.jit(lambda body, state, dt: diagnostics.symplectic_defect(exact(body), state, dt))


@pytest.mark.long
def test_the_angular_velocity_stays_on_poinsot_s_invariable_plane():
    """Ω rolls: its end stays on the plane 2H = π·ω, |Π| is constant, for 200 times in one batch."""
    J, state = setting([1, 2, 3], [0.1, 1, 0.2])
    body = RigidBody(jnp.array(J))

    @jax.jit
    def motion(state, times):
        def invariants(t):
            now = body.solution(state, t)
            Omega = body.angular_velocity(now)
            return so3.Ad(now.q, Omega) @ state.p - 2 * body.energy(state), jnp.linalg.norm(Omega * body.inertia)

        return jax.vmap(invariants)(times)

    height, norm = motion(state, np.linspace(-100.0, 100.0, 200))
    assert height.shape == (200,)
    assert np.abs(height).max() < 1e-14
    assert np.abs(norm - np.linalg.norm(state.p)).max() < 5e-15


@pytest.mark.long
def test_exact_works_at_rest_and_in_single_precision():
    J, state = setting([1, 2, 3], [0, 0, 0])
    assert difference(solve(J, state, 5.0).q, Q) < 3e-16
    of_p = derivative(J, state, 5.0)[1].p
    assert difference(of_p, flow_and_derivative(J, state, 5.0)[0][1].p) < 1e-14
    J, state = setting([1, 2, 3], [0.3, 0.6, 0.8])
    q = solve(J.astype("float32"), jax.tree.map(lambda x: x.astype("float32"), state), np.float32(20)).q
    assert q.dtype == jnp.float32
    assert difference(q, solve(J, state, 20.0).q) < 2e-5
