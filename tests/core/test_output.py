"""Given step boundaries and output at any time."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated import last

import lieint_jax as li
from lieint_jax import diagnostics, runs, schemes, systems
from lieint_jax.core.tangent import distance, value_and_jacobian

pytestmark = pytest.mark.long

TOP = systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])
STATE = TOP.state(angular_velocity=[0.3, 0.5, 0.8])
SPLITTING = schemes.splitting(TOP)
OUTPUTS = np.array([0.0, 0.07, 0.07, 0.3, 0.44, 1.0])
GRADED = 2 * np.sinh(np.linspace(0, 1.2, 13)) / np.sinh(1.2)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_output_is_a_shorter_step_from_the_state_to_the_left(sign):
    nodes = li.integrate(SPLITTING, STATE, sign * 0.1, 10)
    seen = li.integrate(SPLITTING, STATE, sign * 0.1, 10, save_at=sign * OUTPUTS)
    assert seen.info.converged.all()
    np.testing.assert_array_equal(seen.t, sign * np.array([0, *OUTPUTS]))
    for k, (left, rest) in enumerate([(0, 0), (0, 0.07), (0, 0.07), (3, 0), (4, 0.04), (10, 0)]):
        node = jax.tree.map(lambda x: x[left], nodes.state)  # noqa: B023
        one = SPLITTING(node, sign * rest)[0] if rest else node
        assert distance(jax.tree.map(lambda x: x[k + 1], seen.state), one) < 2e-16  # noqa: B023


def test_times_of_another_epoch_are_refused_in_a_sentence():
    """In seconds since 1970, for a state without a time; traced ones are flagged."""
    sentence = (
        r"save_at: 3\.4e\+10 steps lead there.*and 2147483647 are too many.*count from t = 0\.0, .*at their epoch"
    )
    for num_steps in (None, 34 * 10**9):
        with pytest.raises(ValueError, match=sentence):
            li.integrate(SPLITTING, STATE, 0.05, num_steps, save_at=[1.7e9])
    undone = jax.jit(lambda t: li.integrate(SPLITTING, STATE, 0.05, save_at=t, adjoint=li.ReversibleAdjoint()))
    assert undone(jnp.array([0.1, 1.7e9])).info.converged.tolist() == [True, True, False]


@pytest.mark.quick
def test_a_loop_of_any_length_refuses_more_steps_than_it_counts():
    """Of 2³² + 5 steps from one save to the next it took 5, and reported that they converged."""
    clock = runs.uniform_clock(SPLITTING, STATE, jnp.asarray(1e-9))
    assert runs.of_any_length(SPLITTING, STATE, clock, 1, 64, 2**32 + 5) is None


def test_the_clock_is_that_of_the_state():
    start = STATE._replace(t=jnp.asarray(3.0))
    seen = li.integrate(SPLITTING, start, 0.1, 10, save_at=3 + OUTPUTS)
    np.testing.assert_array_equal(seen.state.t, np.array([3, *(3 + OUTPUTS)]))
    np.testing.assert_array_equal(seen.t, seen.state.t)
    path = li.integrate(SPLITTING, start, times=3 + GRADED)
    np.testing.assert_array_equal(path.t, 3 + GRADED)
    np.testing.assert_array_equal(path.state.t, path.t)


@pytest.mark.parametrize(("order", "expected"), [(2, 3), (4, 5)])
def test_between_exact_nodes_the_error_is_one_order_above_the_scheme_s(order, expected):
    """Observed 3.2 and 5.3 from the largest of steps of 0.4 to 0.05 of themselves."""
    step = SPLITTING if order == 2 else schemes.compose(SPLITTING, 4)

    @jax.jit
    def worst(h):
        def error(rest):
            return distance(step(STATE, rest)[0], diagnostics.flow(TOP, STATE, rest, 100))

        return jnp.max(jax.vmap(error)(jnp.linspace(0, 1, 17) * h))

    coarse, fine = worst(0.4), worst(0.05)
    assert np.log(coarse / fine) / np.log(8) == pytest.approx(expected, abs=0.35)


@pytest.mark.parametrize("scheme", ["splitting", "top_energy_momentum"])
def test_steps_between_given_times_conserve_what_the_step_conserves(scheme):
    step = getattr(schemes, scheme)(TOP)
    path = li.integrate(step, STATE, times=GRADED)
    one_by_one = functools.reduce(lambda z, h: step(z, h)[0], np.diff(GRADED), STATE)
    assert distance(last(path), one_by_one) < 2e-15
    space = TOP.phase_space
    end, _, L = value_and_jacobian(space, lambda z: (last(li.integrate(step, z, times=GRADED)), None), STATE)
    defect = jnp.abs(L.T @ space.omega(end) @ L - space.omega(STATE)).max()
    seen = li.integrate(step, STATE, times=GRADED, save_at=[0.4, 1.3])
    H = jax.vmap(TOP.energy)(seen.state)
    if scheme == "splitting":
        assert defect < 2e-14  # observed 3e-15
    else:
        assert defect > 1e-5
        assert np.abs(H - H[0]).max() < 1e-14
    gamma_pi = jax.vmap(TOP.momentum)(seen.state)
    assert np.abs(gamma_pi - gamma_pi[0]).max() < 1e-15


def test_derivatives_by_output_times_and_step_boundaries():
    weights = jnp.array([0.3, -1.0, 0.5, 2.0])

    def value(save_at, times):
        return (li.integrate(SPLITTING, STATE, times=times, save_at=save_at).state.q @ weights)[1:] @ jnp.array(
            [1.0, 2]
        )

    at = jnp.array([0.31, 1.22]), jnp.asarray(GRADED)
    along = jnp.array([1.0, -0.5]), jnp.asarray(np.sin(GRADED))
    forward = jax.jit(lambda *x: jax.jvp(value, x, along)[1])(*at)
    reverse = jax.jit(jax.grad(value, (0, 1)))(*at)
    product = sum(jnp.vdot(a, b) for a, b in zip(reverse, along, strict=True))
    assert product == pytest.approx(float(forward), rel=1e-12, abs=0)
    f = jax.jit(lambda h: value(*(x + h * y for x, y in zip(at, along, strict=True))))
    h = 1e-4
    slope = (f(-2 * h) - 8 * f(-h) + 8 * f(h) - f(2 * h)) / (12 * h)
    assert float(slope) == pytest.approx(float(forward), rel=1e-9)


@pytest.mark.quick
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("adjoint", [None, li.ReversibleAdjoint()], ids=["loop", "undone"])
def test_times_in_any_order_have_the_states_of_times_in_order(adjoint, sign):
    """Known or traced; known ones without a number of steps too."""
    start, order = STATE._replace(t=jnp.asarray(3.0)), np.array([4, 0, 5, 2, 1, 3])
    wanted = 3 + sign * OUTPUTS
    expected = li.integrate(SPLITTING, start, sign * 0.1, 10, save_at=wanted)
    options = dict(dt=sign * 0.1, adjoint=adjoint)
    run = jax.jit(lambda t: li.integrate(SPLITTING, start, num_steps=10, save_at=t, **options))
    for seen in li.integrate(SPLITTING, start, save_at=wanted[order], **options), run(wanted[order]):
        np.testing.assert_array_equal(seen.t, [3, *wanted[order]])
        np.testing.assert_array_equal(seen.state.t, seen.t)
        assert seen.info.converged.all()
        assert seen.info.residual.max() <= expected.info.residual.max()
        assert distance(jax.tree.map(lambda x: x[0], seen.state), start) == 0
        for a, b in zip(jax.tree.leaves(seen.state), jax.tree.leaves(expected.state), strict=True):
            np.testing.assert_allclose(a[1:], b[1:][order], rtol=0, atol=5e-16)


@pytest.mark.quick
def test_a_time_at_the_end_of_a_run_in_float32_is_inside_of_it():
    """At multiples of dt that are rounded otherwise than the clock's: a traced one was flagged, a known one refused."""
    step = schemes.exact(systems.rigid_body(np.array([1.0, 2.0, 3.0], np.float32)))
    start = jax.tree.map(lambda x: x.astype(np.float32), step.system.state(angular_velocity=[0.2, 0.3, 1.0]))
    dt, end = np.float32(0.7), np.array([6.3], np.float32)
    assert end > 9 * dt  # by one unit of the last digit
    for run in (
        li.integrate(step, start, dt, 9, save_at=end),
        jax.jit(lambda t: li.integrate(step, start, dt, 9, save_at=t))(end),
    ):
        assert run.info.converged.all()


def test_traced_times_outside_the_run_are_flagged():
    run = jax.jit(lambda t: li.integrate(SPLITTING, STATE, 0.1, 10, save_at=t))
    seen = run(jnp.array([-0.1, 0.5, 0.3, 1.2, jnp.nan, 0.7]))
    assert seen.info.converged.tolist() == [True, False, True, True, False, False, True]
    middle = li.integrate(SPLITTING, STATE, 0.1, 5, save_every=5)
    assert distance(jax.tree.map(lambda x: x[2], seen.state), last(middle)) < 1e-15
