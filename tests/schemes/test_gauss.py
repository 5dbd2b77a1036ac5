"""Gauss collocation in canonical coordinates, and extrapolated midpoint steps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slopes
from grid import examples_of

import lieint_jax as li
from lieint_jax import _discover, diagnostics, schemes, systems
from lieint_jax._numerics import collocation
from lieint_jax.core.tangent import distance
from lieint_jax.diagnostics import flow
from lieint_jax.schemes._extrapolate import _extrapolation, _fractions, weights
from lieint_jax.schemes.charts import body_axes, canonical
from lieint_jax.schemes.charts.canonical import canonical_chart

TOP, STATE, _ = examples_of("heavy_top")["asymmetric_top"]
STEP = schemes.gauss(TOP)
_Equation = _discover.modules_with("examples", schemes)["gauss"]._Equation


@functools.cache
def example(name):
    """A system, a state and a moderate step: |Δt Ω| up to 0.6."""
    if name == "top":
        return TOP, STATE, 0.25
    if name == "elastic":
        body = systems.pseudo_rigid_body([1.0, 1.2, 0.8], systems.neo_hookean(3.0, 2.0))
        return body, body.state(velocity=[[0.3, -0.9, 0.2], [0.8, 0.1, -0.3], [-0.1, 0.4, -0.2]]), 0.25
    if name == "binary":
        system, state, _ = examples_of("rigid_bodies")["binary"]
        return system, state, 0.4
    if name == "many":
        masses, moments = jnp.arange(1.0, 6.0), jnp.array([[0.1, 0.12, 0.15]] * 5)
        system = systems.rigid_bodies(masses, moments, li.potentials.maccullagh(1.0, masses, moments))
        places = 4 * jnp.stack([jnp.arange(5.0), jnp.array([0.0, 1, 0, -1, 1]), jnp.array([1.0, 0, 2, 0, 0])], axis=1)
        return system, system.state(places, velocities=places[::-1] / 20, angular_velocities=places / 9), 0.2
    body = {
        "free": systems.rigid_body([1.0, 2.0, 2.6]),
        "gyrostat": systems.gyrostat([1.0, 2.0, 2.6], [0.2, -0.1, 0.4]),
        "driven": systems.driven_top([1.0, 2.0, 2.6], lambda Gamma, t: (1 + 0.3 * jnp.sin(2 * t)) * Gamma[2]),
    }[name]
    more = {"t": 0.3, "work": 0.0} if name == "driven" else {}
    return body, body.state([1.0, 0, 0, 0], angular_velocity=[0.4, 0.5, 0.9], **more), 0.5


LARGER = [pytest.param(name, marks=pytest.mark.long) for name in ("driven", "binary", "many")]


@pytest.mark.parametrize("name", ["top", "gyrostat", *LARGER])
def test_canonical_coordinates_are_those_of_the_system(name):
    """There and back; their rate pushed forward is the vector field; the pair (q, p) has the lengths that it should."""
    system, state, _ = example(name)
    chart, t = canonical_chart(system), state.t
    z = chart.unknowns(system, state)

    def back(z):
        spin = 0.5 * canonical._times_conjugate(z.p[-4:], z.q[-4:])
        return chart.configuration(z), jnp.stack([*z.p[:-4], *spin], axis=-1).reshape(state.p.shape)

    for there, here in zip(back(z), state[:2], strict=True):
        np.testing.assert_allclose(there, here, rtol=0, atol=1e-15 * float(jnp.abs(here).max()))
    _, pushed = jax.jvp(back, (z,), (chart.rate(system)(z, t),))
    for a, b in zip(pushed, system.vector_field(state)[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-15 * float(jnp.abs(b).max()))
    torque = system.vector_field(state).p
    found = jnp.stack(chart.force(system)(z, t), axis=-1).reshape(torque.shape)
    np.testing.assert_allclose(found, torque, rtol=0, atol=1e-15 * float(jnp.abs(torque).max()))
    q, p = (jnp.stack(x).reshape(4, -1)[:, 0] for x in (z.q[-4:], z.p[-4:]))
    assert abs(float(q @ p)) < 1e-15
    spin = state.p.reshape(-1, state.p.shape[-1])[0, -3:]
    assert float(p @ p) == pytest.approx(4 * float(spin @ spin), rel=1e-14, abs=0)


@pytest.mark.long
def test_gauss_conserves_form_and_momentum_of_elastic_bodies_and_is_reversible():
    """The grid has the other systems. Observed: form 1e-15, momentum and way back 1e-16, energy 2e-16."""
    system, state, dt = example("elastic")
    step = schemes.gauss(system)
    end, info = jax.jit(step)(state, dt)
    assert info.converged
    assert diagnostics.symplectic_defect(step, state, dt) < 2e-14
    assert jnp.max(jnp.abs(system.momentum(end) - system.momentum(state))) < 1e-15
    assert diagnostics.reversibility(step, state, dt) < 3e-15
    assert abs(float(system.energy(end) - system.energy(state))) < 4e-15


def test_the_work_on_a_body_at_rest_is_the_quadrature_of_the_power():
    """V = t³ does not move the body; two stages integrate its power 3t² exactly, at the nodes of the step alone."""
    body = systems.driven_top([1.0, 2.0, 2.6], lambda Gamma, t: t**3 + 0 * Gamma[0])
    start = li.State(jnp.array([1.0, 0, 0, 0]), jnp.zeros(3), jnp.array(0.4), jnp.array(0.0))
    step = schemes.gauss(body, 2)
    end, info = jax.jit(step)(start, 0.5)
    assert info.converged
    assert float(end.work) == pytest.approx(0.9**3 - 0.4**3, rel=1e-15, abs=0)
    nodes, Y = collocation.nodes(2), tuple(jnp.zeros((2, 8)).T)
    [times] = _Equation.from_state(step, start, jnp.array(0.5)).at_stages(lambda z, t: (t,), Y, nodes)
    np.testing.assert_allclose(times, 0.4 + 0.5 * nodes, rtol=1e-15)


def test_derivatives_converge_where_the_sweeps_do():
    """By dt at |ΔtΩ| = 1, where the equations of the derivative need as many sweeps as those of the step."""
    body = systems.rigid_body([1.0, 2.0, 2.6])
    start = body.state(angular_velocity=[0.4, 0.5, 0.77])

    @jax.jit
    def both(dt):
        def end(dt):
            return schemes.gauss(body, 2)(start, dt)[0].q

        at = jax.vmap(end)(dt + 1e-3 * jnp.array([-2.0, -1, 1, 2]))
        return jax.jvp(end, (dt,), (1.0,))[1], (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / 12e-3

    own, differences = both(1.0)
    np.testing.assert_allclose(own, differences, rtol=0, atol=1e-11)


@pytest.mark.long
def test_energy_and_momentum_over_a_long_run():
    """2000 steps of 0.1; observed 5e-15 and 0."""
    path = li.Run.of(STEP, li.integrate(STEP, STATE, 0.1, 2000, save_every=20))
    assert path.info.converged.all()
    assert float(jnp.abs(path.energy_error()).max()) < 3e-14
    assert float(jnp.abs(path.momentum_error()).max()) < 1e-15


@pytest.mark.long
@pytest.mark.parametrize("group", [li.groups.so3, li.groups.special_linear(2)], ids=["SO(3)", "SL(2)"])
def test_in_a_canonical_chart_of_a_group_the_form_is_conserved_and_the_momentum_is_not(group):
    """Why `gauss` takes no groups: q = exp(ξ) qₙ and η = dexp*π are canonical at any qₙ, but π is not quadratic.

    Geodesics, so π is constant. Observed: form 2e-16; π moves by 1.5e-7 and 8e-8 at Δt = 0.4, with order 5.
    """
    metric, (_, A, b) = jnp.array([1.0, 2.0, 2.6]), collocation.gauss(2)

    def dexp(xi):
        q = group.exp(xi)
        return jax.vmap(lambda e: group.spatial_velocity(q, jax.jvp(group.exp, (xi,), (e,))[1]), out_axes=1)(jnp.eye(3))

    def momentum(z):
        return jnp.linalg.solve(dexp(z[:3]).T, z[3:])

    def energy(z):
        Pi = group.Ad_star(group.exp(z[:3]), momentum(z))
        return jnp.sum(Pi * Pi / metric) / 2

    def rate(z):
        slope = jax.grad(energy)(z)
        return jnp.concatenate([slope[3:], -slope[:3]])

    @jax.jit
    def step(z, dt):
        def sweep(_, k):
            return jax.vmap(lambda a: rate(z + dt * a @ k))(jnp.asarray(A))

        return z + dt * b @ jax.lax.fori_loop(0, 60, sweep, jnp.zeros((2, 6)))

    z = jnp.array([1e-3, -2e-3, 1e-3, 0.8, 1.1, -0.7])
    L, J = jax.jacfwd(step)(z, 0.4), jnp.kron(jnp.array([[0.0, 1.0], [-1.0, 0.0]]), jnp.eye(3))
    assert jnp.abs(L.T @ J @ L - J).max() < 2e-15
    moved = [float(jnp.abs(momentum(step(z, dt)) - momentum(z)).max()) for dt in (0.4, 0.2)]
    assert moved[0] > 1e-9
    assert np.log2(moved[0] / moved[1]) == pytest.approx(5, abs=0.5)


@pytest.mark.long
def test_too_few_sweeps_and_too_long_steps_are_flagged():
    step = schemes.gauss(TOP, sweeps=4)
    few, info = jax.jit(step)(STATE, 0.25)
    assert not info.converged
    assert 1e-12 < info.residual < 1e-2
    assert distance(few, STEP(STATE, 0.25)[0]) < 1e-3
    assert not li.integrate(step, STATE, 0.25, 2).info.converged[1:].any()  # asked for, so reported, not refused
    with pytest.warns(RuntimeWarning, match="1 of 1 members did not converge at every step"):
        li.run(step, jax.tree.map(lambda x: x[None], STATE), 0.25, 2, progress=False, save_every=None)
    assert not jax.jit(STEP)(STATE, 30.0)[1].converged
    with pytest.raises(ValueError, match=r"its sweeps diverge.* Use a smaller dt"):
        li.integrate(STEP, STATE, 30.0, 1)


@pytest.mark.long
@pytest.mark.parametrize("size", [1e-50, 1e50])
def test_a_step_of_gauss_is_independent_of_units(size):
    """A step does not depend on the unit of momentum; observed: 3e-16."""

    @jax.jit
    def step(unit, state):
        top = systems.heavy_top(unit * jnp.array([1.0, 2.0, 2.5]), unit * jnp.array([0.5, 0.4, 1.0]))
        return schemes.gauss(top, 6)(state, 0.3)

    end, info = step(1.0, STATE)
    other, same = step(size, STATE._replace(p=size * STATE.p))
    assert info.converged
    assert same.converged
    np.testing.assert_allclose(other.q, end.q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(other.p / size, end.p, rtol=0, atol=1e-15)


def test_the_polynomial_through_the_nodes_has_exact_values_and_integrals():
    """Of degree 3 through 4 nodes, at 7: its values and its integrals; observed 1.1e-15 and 6e-17."""
    c, at = collocation.nodes(4), collocation.nodes(7)
    np.testing.assert_allclose(collocation.values(4, at) @ c**3, at**3, rtol=0, atol=4e-15)
    np.testing.assert_allclose(collocation.integrals(4, at) @ c**3, at**4 / 4, rtol=0, atol=3e-16)


def test_the_weights_of_extrapolation_cancel_even_powers():
    numbers = [2, 4, 6, 8, 10, 12]
    w = np.array(weights(numbers))
    sums = [np.sum(w * np.array(numbers, float) ** (-2 * k)) for k in range(6)]
    np.testing.assert_allclose(sums, [1, 0, 0, 0, 0, 0], rtol=0, atol=1e-14)


def test_extrapolation_samples_the_time_of_each_sub_step():
    """u̇ = u cos t from u = 1 at order 12."""
    numbers = [2, 4, 6, 8, 10, 12]

    def end(t0, dt):
        moments = t0 + dt * jnp.asarray(_fractions(numbers))
        return _extrapolation(lambda u, t: u * jnp.cos(t), moments, jnp.ones(()), dt, numbers, True)[0]

    expected = np.expm1(np.sin(0.6) - np.sin(0.3))
    assert float(jax.jit(end)(0.3, 0.3)) == pytest.approx(expected, rel=3e-14, abs=0)


def test_extrapolation_follows_the_axis_of_a_driven_top_through_the_step():
    top = systems.driven_top([1.0, 2.0, 2.6], lambda Gamma, t: Gamma[2], lambda t: jnp.stack([t, 0 * t, 1 + 0 * t]))
    state = li.State(jnp.array([1.0, 0, 0, 0]), jnp.zeros(3), jnp.array(0.4))
    found = body_axes.BODY_AXES.stage_times(top, state, jnp.array([0.0, 0.1, 0.3]))
    np.testing.assert_allclose(found.t, [0.4, 0.5, 0.7], rtol=1e-15)
    np.testing.assert_allclose(found.axis, [[0.4, 0, 1], [0.5, 0, 1], [0.7, 0, 1]], rtol=1e-15)


def leaning():
    """A heavy top of full inertia whose axis leans, points down and is not of unit length."""
    top = systems.heavy_top([[1.1, 0.2, 0.1], [0.2, 1.8, -0.3], [0.1, -0.3, 2.2]], [0.5, 0.4, 1.0], (0.3, -0.5, -1.2))
    return top, top.state([0.5, -0.5, 0.1, 0.7], angular_velocity=[0.4, -0.8, 0.9])


@pytest.mark.long
@pytest.mark.parametrize("name", ["leaning", "gyrostat", "driven", "binary"])
def test_a_converged_step_of_gauss_is_the_flow(name):
    """Also of a top whose axis leans, and is not of length 1."""
    if name == "leaning":
        system, state = leaning()
    else:
        system, state, _ = examples_of("rigid_bodies")[name] if name == "binary" else example(name)
    step = schemes.gauss(system, 6)
    expected, info = jax.jit(step)(state, 0.1)
    assert info.converged
    assert float(distance(expected, flow(system, state, 0.1, 20), system.phase_space)) < 2e-14


@pytest.mark.long
def test_increments_preserve_the_last_digits():
    """After 2000 steps, by the energy; observed: 4e-15 with increments, 1.7e-13 without."""
    drift = {}
    for increments in (True, False):
        path = li.integrate(schemes.extrapolate(TOP, 12, increments), STATE, 0.05, 2000, save_every=50)
        H = np.asarray(jax.vmap(TOP.energy)(path.state))
        drift[increments] = np.max(np.abs(H / H[0] - 1))
    assert drift[True] < 1.5e-14
    assert 3e-14 < drift[False] < 6e-13


@pytest.mark.long
def test_extrapolation_has_derivatives_by_the_axis():
    """The axis leans, and its length counts."""
    top, state = leaning()
    slopes.assert_agree(schemes.extrapolate(top, 8), state, 0.2)
