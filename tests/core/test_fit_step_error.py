"""A fit measures what the error of the simulation's steps does to its estimate, by a run with half the step size."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.fitting._step_error import with_halved_steps
from lieint_jax.runs import halved_steps

RATE, DT, READINGS, NOISE = jnp.array([15.0, 9.0, 10.0]), 0.01, 60, 0.3  # a gyro of 100 Hz on a body of 20 rad/s
TRUTH = jnp.array([0.1940, 0.9])
FINE = 16  # steps between readings


def gyro(ratios, scheme=None, steps=1):
    """The readings, and whether the steps converged."""
    body = li.systems.RigidBody(jnp.append(ratios, 1.0))
    state = body.state(angular_velocity=RATE)
    if scheme is None:
        states = jax.vmap(lambda t: body.solution(state, t))(DT * jnp.arange(READINGS + 1))
        return jax.vmap(body.angular_velocity)(states), True
    run = li.integrate(scheme(body), state, DT / steps, READINGS * steps, save_every=steps)
    return jax.vmap(body.angular_velocity)(run.state), run.info.converged


DATA = np.asarray(gyro(TRUTH)[0]) + NOISE * np.random.default_rng(0).normal(size=(READINGS + 1, 3))


def residuals(scheme=li.schemes.so3_explicit, steps=1):
    @jax.jit
    def standardized(ratios):
        readings, converged = gyro(ratios, scheme, steps)
        return (readings - DATA) / NOISE, converged

    return standardized


def fitted(loss):
    return li.fit(loss, 1.02 * TRUTH, bounds=li.fitting.inertia_ratios, standardized=True, progress=False)


@pytest.mark.long
def test_a_fit_warns_if_the_steps_move_a_parameter_by_more_than_a_fifth_of_its_error():
    """The loss is jitted and was called before; the estimated shift is that from a fit with a sixteenth of the step."""
    coarse = residuals()
    coarse(TRUTH)
    with pytest.warns(UserWarning, match=r"the error of the steps moves \[0\] = .* standard errors"):
        biased = fitted(coarse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fine = fitted(residuals(steps=FINE))
    assert biased.success
    assert fine.success
    assert (fine.message, biased.message.count("use a smaller dt")) == ("", 1)
    moved = float(biased.params[0] - fine.params[0])
    assert abs(moved) > 0.5 * float(fine.standard_errors[0])
    assert float(biased.message.split(" by about ")[1].split(",")[0]) == pytest.approx(moved, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme", [None, li.schemes.calibrated, li.schemes.exact], ids=["solution", "calibrated", "exact"]
)
def test_exact_steps_are_not_run_again(scheme):
    assert jax.eval_shape(lambda p: with_halved_steps(residuals(scheme), p), TRUTH) is None


BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_explicit(BODY)
START = BODY.state(angular_velocity=[0.2, 0.1, 1.0])
TIMES = jnp.array([0.0, 0.1, 0.3, 0.4])


def between(times, n):
    """Each interval of the times in n parts."""
    return jnp.interp(jnp.arange(n * (len(times) - 1) + 1) / n, jnp.arange(len(times)), times)


RUNS = {
    "integrate": lambda n: li.integrate(STEP, START, 0.2 / n, 4 * n, save_every=2 * n),
    "times": lambda n: li.integrate(
        STEP, START, times=jnp.interp(jnp.arange(3 * n + 1) / n, jnp.arange(4), TIMES), save_every=n
    ),
    "save_at": lambda n: li.integrate(STEP, START, 0.2 / n, 4 * n, save_at=jnp.array([0.1, 0.7])),
    "save_at, undone": lambda n: li.integrate(
        STEP, START, 0.2 / n, save_at=jnp.array([0.7, 0.1]), adjoint=li.ReversibleAdjoint()
    ),
    "event": lambda n: li.event(STEP, START, 0.2 / n, lambda z: z.q[0] - 0.9, max_steps=20 * n),
}


@pytest.mark.long
@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS)
def test_every_run_in_the_context_has_steps_of_half_the_size(run):
    with halved_steps() as runs:
        found = run(1)
    assert runs.orders == [2.0]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-14), found, run(2))
