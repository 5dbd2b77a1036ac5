"""Three derivatives, one answer: forward, reverse through the scan, reverse by undoing steps; and differences."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import steps
from small_steps import Leapfrog, Oscillators, leapfrog

import lieint_jax as li
from lieint_jax.types import State

pytestmark = pytest.mark.long

GRID = {name: rest for name, *rest in steps() if rest[0].symmetric}  # others cannot be undone


BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = BODY.state(angular_velocity=[0.2, 0.3, 1.0])
STEP = li.schemes.so3_midpoint(BODY)


def end(J, state, dt, num_steps=40, **options):
    step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
    return li.reversible(step, state, dt, num_steps, **options).state.q[-1, 0]


def test_the_trajectory_is_that_of_integrate():
    ours, theirs = li.reversible(STEP, STATE, 0.05, 12, save_every=4), li.integrate(STEP, STATE, 0.05, 12, save_every=4)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
    assert li.reversible(STEP, STATE, 0.05, 0).t.shape == (1,)


def test_batches_of_states_and_of_parameters():
    J = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.5, 2.8]])
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.array([[0.2, 0.3, 1.0], [0.5, -0.3, 0.2]]))
    both = jax.jit(jax.vmap(jax.grad(end), (0, 0, None)))(J, states, 0.05)
    alone = [jax.jit(jax.grad(end))(J[k], State(states.q[k], states.p[k]), 0.05) for k in (0, 1)]
    np.testing.assert_allclose(both, jnp.stack(alone), rtol=1e-12)


def test_functions_of_a_step_may_close_over_what_is_differentiated():
    def bent(c, run):
        step = li.schemes.so3_midpoint(BODY, lambda x: 1 + c * x)
        return run(step, STATE, 0.5, 8).state.q[-1, 0]

    slopes = [jax.jit(jax.grad(lambda c, run=run: bent(c, run)))(0.3) for run in (li.reversible, li.integrate)]
    assert slopes[0] == pytest.approx(float(slopes[1]), rel=1e-12, abs=0)
    assert abs(slopes[0]) > 1e-6


@pytest.mark.parametrize("derivative", ["reversible", "checkpoint"])
def test_a_run_of_zero_steps_has_the_derivative_of_the_identity(derivative):
    def end(q):
        return li.reversible(STEP, State(q, STATE.p), 0.05, 0, derivative=derivative).state.q[-1, 1]

    np.testing.assert_array_equal(jax.grad(end)(STATE.q), [0, 1, 0, 0])


@pytest.mark.parametrize("times", [[], [0.0, 0.0]])
def test_observations_of_no_time_and_at_the_start(times):
    def seen(q):
        return li.observe(STEP, State(q, STATE.p), 0.05, np.array(times), derivative="checkpoint")[0].q

    assert seen(STATE.q).shape == (len(times), 4)
    identity = np.broadcast_to(np.diag([0.0, 1, 1, 1]), (len(times), 4, 4))  # the last, empty step keeps |q| = 1
    np.testing.assert_allclose(jax.jacrev(seen)(STATE.q), identity, rtol=0, atol=1e-15)


SECOND = [
    "rigid_body.asymmetric-so3_midpoint[symplectic]",
    "rigid_body.asymmetric-so3_midpoint[cayley]",
    "rigid_body.asymmetric-preprocessed[6]",
    "heavy_top.asymmetric_top-splitting[so3_midpoint[symplectic]]",
    "pendulum.uniform-sphere_midpoint[plain]",
]


@pytest.mark.parametrize("name", SECOND)
def test_second_derivatives_through_a_run(name):
    """Forward over reverse, as `jax.hessian` has it, against forward over forward. JAX differentiates the solver itself
    there, not the equation: the iterations must carry derivatives."""
    step, state, dt = GRID[name]
    space, rng = step.system.phase_space, np.random.default_rng(0)
    at = (jnp.zeros(space.dim), jnp.asarray(dt))
    one, two = ((jnp.asarray(rng.normal(size=space.dim)), jnp.asarray(k * dt)) for k in (0.2, 0.3))

    def value(delta, dt):
        end = li.integrate(step, space.perturb(state, delta), dt, 3, save_every=3).state
        return jnp.sum(jnp.sin(end.q[-1])) + jnp.sum(end.p[-1] ** 2)

    def along(way):
        return lambda t: jax.tree.map(lambda x, d: x + t * d, at, way)

    @jax.jit
    def both():
        def slope(t):
            return sum(jnp.vdot(g, d) for g, d in zip(jax.grad(value, (0, 1))(*along(two)(t)), one, strict=True))

        def forward(t):
            return jax.jvp(lambda s: value(*jax.tree.map(lambda x, d: x + s * d, along(two)(t), one)), (0.0,), (1.0,))[
                1
            ]

        return jax.jvp(slope, (0.0,), (1.0,))[1], jax.jvp(forward, (0.0,), (1.0,))[1]

    reverse, forward = both()
    assert float(reverse) == pytest.approx(float(forward), rel=1e-14, abs=0)  # floor 1e-15


def test_a_hessian_by_undoing_steps():
    def slope(J):
        return jax.grad(lambda J: end(J, STATE, 0.05))(J)

    def plain_end(J):
        return li.integrate(li.schemes.so3_midpoint(li.systems.RigidBody(J)), STATE, 0.05, 40).state.q[-1, 0]

    forward = jax.jit(jax.jacfwd(jax.jacfwd(plain_end)))(BODY.inertia)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(slope))(BODY.inertia), forward, rtol=1e-11, atol=1e-12)  # 1e-15


def test_a_hessian_by_undoing_steps_in_the_step_size_and_the_initial_time():
    """Of a driven body too: the tangent vectors of the clock, not its states alone, pass the backward run."""

    def torque(t, q, omega):
        return jnp.stack([jnp.sin(t), 0.3 * t, jnp.cos(t)]) - 0.1 * omega

    def last(x, adjoint):
        step = li.schemes.torqued_midpoint(li.systems.torqued_body(x[:3], torque, "body"))
        state = STATE._replace(t=x[4])
        return jnp.sum(li.integrate(step, state, x[3], 6, save_every=2, adjoint=adjoint).state.p[1:] ** 3)

    at = jnp.array([1.0, 2.0, 3.0, 0.05, 0.7])
    undone, plain = li.adjoints.ReversibleAdjoint(), li.adjoints.RecursiveCheckpointAdjoint()
    forward = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: last(x, plain))))(at)
    np.testing.assert_allclose(jax.jit(jax.hessian(lambda x: last(x, undone)))(at), forward, rtol=1e-11, atol=1e-12)


def temporaries(make, num_steps):
    def last(J, states):
        step = make(li.schemes.so3_midpoint(li.systems.RigidBody(J)))
        return jnp.sum(jax.vmap(lambda z: li.reversible(step, z, 0.05, num_steps).state.q[-1, 0])(states))

    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.ones((100, 3)))
    return jax.jit(jax.grad(last)).lower(BODY.inertia, states).compile().memory_analysis().temp_size_in_bytes


def test_memory_does_not_grow_with_the_number_of_steps():
    assert temporaries(lambda step: step, 40_000) <= temporaries(lambda step: step, 40) + 64


def test_a_composition_is_undone_in_the_memory_of_its_base_step():
    """It has 19 sub-steps."""
    assert temporaries(lambda step: li.schemes.compose(step, 8), 40) <= 1.5 * temporaries(lambda step: step, 40)


def observed(step, state, dt, times, **options):
    return li.observe(step, state, dt, times, **options)[0]


def test_observations_at_any_times():
    """The exact flow takes whole and shorter steps alike, so any times must be met to round-off, in any order."""
    exact = li.schemes.exact(BODY)
    times = jnp.array([0.33, 0.0, 1.0, 0.05, 0.071, 0.33])
    for derivative in ("reversible", "checkpoint"):
        seen, info = li.observe(exact, STATE, 0.05, times, derivative=derivative)
        true = jax.vmap(BODY.solution, (None, 0), State(0, None))(STATE, times)
        np.testing.assert_allclose(seen.q, true.q, rtol=0, atol=1e-14)
        assert info.converged.all()
    back = li.observe(exact, STATE, -0.05, -times)[0]
    np.testing.assert_allclose(back.q[0], BODY.solution(STATE, -0.33).q, rtol=0, atol=1e-14)


def test_traced_times_that_are_not_reached_are_flagged_and_harm_no_other():
    seen = jax.jit(lambda dt, t: li.observe(STEP, STATE, dt, t))
    state, info = seen(0.05, jnp.array([-0.5, 0.5, 0.52]))
    assert info.converged.tolist() == [False, True, True]
    end = li.integrate(STEP, STATE, 0.05, 10, save_every=10).state.q[-1]
    np.testing.assert_allclose(state.q[1], end, rtol=0, atol=1e-14)
    assert not seen(0.0, jnp.array([0.5, 0.5, 0.5]))[1].converged.any()


def observed_by_matrices(gammas, stiffness, dt, times):
    """The first entry of q at the times, from q = 1 and p = 0: whole steps of a composition, then a shorter one."""

    def step(h):
        return np.linalg.multi_dot([leapfrog(stiffness, gamma * h) for gamma in gammas])

    whole = [int(np.real(t) / np.real(dt)) for t in times]
    return [(step(t - n * dt) @ np.linalg.matrix_power(step(dt), n))[0, 0] for t, n in zip(times, whole, strict=True)]


@pytest.mark.quick
def test_derivatives_of_observations_of_a_composition_by_the_complex_step():
    """In the stiffness, dt and the times, through sub-steps of different sizes and through the shorter last step."""
    weights, times, dt, stiffness = np.array([1.0, -0.7, 0.4]), np.array([0.71, 0.28, 0.33]), 0.1, 1.3
    start = State(jnp.eye(3), jnp.zeros((3, 3)))

    def composed(stiffness):
        return li.schemes.compose(Leapfrog(Oscillators(stiffness)), 4, "triple_jump")

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        return weights @ li.observe(composed(x[0]), start, x[1], x[2:])[0].q[:, 0, 0]

    at, gammas = np.array([stiffness, dt, *times]), composed(stiffness).gammas
    value, slopes = loss(at)
    assert float(value) == pytest.approx(weights @ observed_by_matrices(gammas, stiffness, dt, times), abs=1e-14)
    for k, slope in enumerate(slopes):
        x = at + 1e-30j * np.eye(5)[k]
        exact = np.imag(weights @ observed_by_matrices(gammas, x[0], x[1], x[2:])) * 1e30
        assert float(slope) == pytest.approx(exact, abs=2e-14)  # observed 2e-15
        assert abs(exact) > 1e-4


@li.pytree
class TimedLeapfrog(Leapfrog):
    """`Leapfrog` with a stiffness that changes in time."""

    order, symmetric, name = 2, True, "timed_leapfrog"

    def advance(self, state, dt):
        first, last = (dt / 2 * self.system.stiffness * (1 + jnp.sin(t)) for t in (state.t, state.t + dt))
        p = state.p - first * state.q
        q = state.q + dt * p
        return state._replace(q=q, p=p - last * q), li.StepInfo.empty(state.p)


@pytest.mark.quick
def test_observations_of_a_batch_with_one_clock_are_differentiable():
    """JAX 0.12 refuses the cotangent of a time that the members share; slopes against differences, floor 3e-10."""

    def loss(x, q):
        start = State(q * jnp.eye(3), jnp.zeros((3, 3)), x[2])
        return jnp.sum(li.observe(TimedLeapfrog(Oscillators(x[0])), start, x[1], x[3:])[0].q[:, 0, 0])

    batch = jax.jit(jax.value_and_grad(lambda x: jnp.sum(jax.vmap(loss, (None, 0))(x, jnp.array([0.5, 2.0])))))
    x = jnp.array([1.3, 0.1, 0.2, 0.93, 0.47])  # stiffness, dt, the first time, times of observations
    slopes, h = batch(x)[1], 1e-6
    differences = [(batch(x + h * e)[0] - batch(x - h * e)[0]) / (2 * h) for e in jnp.eye(5)]
    np.testing.assert_allclose(slopes, differences, rtol=0, atol=2e-9)
    assert (jnp.abs(slopes) > 1e-4).all()


@pytest.mark.quick
def test_the_clock_of_checkpoints_is_that_of_the_run():
    start = State(jnp.eye(3), jnp.zeros((3, 3)), jnp.array(0.3))
    run_step = Leapfrog(Oscillators(jnp.array(1.3)))
    run = li.reversible(run_step, start, 0.1, 6, save_every=2, derivative="checkpoint")
    np.testing.assert_allclose(run.state.t, [0.3, 0.5, 0.7, 0.9], rtol=1e-15)
    seen, _ = li.observe(run_step, start, 0.1, [0.4, 0.7, 0.9], derivative="checkpoint")
    np.testing.assert_allclose(seen.t, [0.4, 0.7, 0.9], rtol=1e-15)
    start, times = start._replace(p=jnp.ones((3, 3))), [0.7, 0.9, 0.45]
    seen, undone = (
        li.observe(run_step, start, 0.1, times, derivative=name)[0] for name in ("checkpoint", "reversible")
    )
    np.testing.assert_allclose(seen.t, times, rtol=1e-15)
    np.testing.assert_allclose(seen.q, undone.q, rtol=1e-14, atol=1e-15)


ADJOINTS = {"reversible": li.adjoints.ReversibleAdjoint(), "checkpoint": li.adjoints.RecursiveCheckpointAdjoint()}


@pytest.mark.parametrize("name", ADJOINTS)
def test_an_adjoint_of_integrate_is_the_function_of_the_same_derivative(name):
    """Run and gradient to the bit; and they are those of the loop to round-off."""
    step, start = Leapfrog(Oscillators(jnp.array(1.3))), State(jnp.eye(3), jnp.ones((3, 3)), jnp.array(0.3))
    weights = jnp.arange(4.0)[:, None, None]
    runs = {
        "option": functools.partial(li.integrate, adjoint=ADJOINTS[name]),
        "function": functools.partial(li.reversible, derivative=name),
        "loop": li.integrate,
    }

    def loss(run, start):
        path = run(step, start, 0.1, 6, save_every=2)
        return jnp.sum(path.state.q * path.state.p * weights), path

    option, function, loop = (
        jax.jit(jax.grad(functools.partial(loss, run), has_aux=True))(start) for run in runs.values()
    )
    for x, y, z in zip(*map(jax.tree.leaves, (option, function, loop)), strict=True):
        np.testing.assert_array_equal(x, y)
        np.testing.assert_allclose(x, z, rtol=1e-13, atol=1e-13)


@pytest.mark.quick
def test_checkpoints_of_steps_between_given_times():
    times = jnp.array([0.3, 0.4, 0.55, 0.6, 0.9, 1.0, 1.02])

    def loss(q, **options):
        start = State(q, jnp.ones((3, 3)), jnp.array(0.3))
        run = li.integrate(Leapfrog(Oscillators(jnp.array(1.3))), start, times=times, save_every=3, **options)
        return jnp.sum(run.state.q**3)

    expected = jax.jit(jax.grad(loss))(jnp.eye(3))
    adjoint = li.adjoints.RecursiveCheckpointAdjoint()
    found = jax.jit(jax.grad(functools.partial(loss, adjoint=adjoint)))(jnp.eye(3))
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


def test_derivatives_of_observations_in_everything():
    times = jnp.array([0.33, 1.02, 0.071])  # at a step's end the derivative by dt is that of one side

    def loss(derivative, J, state, dt, times):
        step = li.schemes.so3_explicit(li.systems.RigidBody(J))  # its `prepare` depends on everything
        q = li.observe(step, state, dt, times, derivative=derivative)[0].q
        return jnp.sum(q * jnp.arange(12.0).reshape(3, 4))

    at = (BODY.inertia, STATE, 0.05, times)
    reverse = jax.jit(jax.grad(lambda *x: loss("reversible", *x), argnums=(0, 1, 2, 3)))(*at)
    for k in (0, 1):  # times and dt must be concrete for checkpoints
        other = jax.jit(jax.grad(lambda x, k=k: loss("checkpoint", *at[:k], x, *at[k + 1 :])))(at[k])
        for one, two in zip(jax.tree.leaves(reverse[k]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-11)
    h = 1e-4
    value = jax.jit(lambda dt, t: loss("reversible", *at[:2], dt, t))
    slope = [value(0.05 + k * h / 10, times) for k in (-2, -1, 1, 2)]
    assert (slope[0] - 8 * slope[1] + 8 * slope[2] - slope[3]) / 1.2 / h == pytest.approx(float(reverse[2]), rel=1e-6)
    slope = [value(0.05, times.at[0].add(k * h)) for k in (-2, -1, 1, 2)]
    assert (slope[0] - 8 * slope[1] + 8 * slope[2] - slope[3]) / 12 / h == pytest.approx(float(reverse[3][0]), rel=1e-7)


def test_round_trips_are_measured_and_lost_digits_draw_a_warning():
    """A chaotic top comes back less and less; a gradient over that time says so, unless states are saved in between."""
    step, state, dt = GRID["heavy_top.asymmetric_top-splitting[so3_midpoint[symplectic]]"]
    trip = jax.jit(li.adjoints.round_trip_error, static_argnums=3)
    assert trip(step, state, dt, 100) < 1e-13  # 2e-14
    lost = trip(step, state, dt, 4000)
    assert lost > 1e-9  # the largest Lyapunov exponent is 0.086: e^(0.086 · 200) = 3e7

    def slope(save_every, k):
        def last(dt, p):
            return li.reversible(step, State(state.q, p), dt, 4000, save_every=save_every).state.q[-1, 0]

        return jax.jit(jax.grad(last, argnums=k))(jnp.asarray(dt), state.p)

    for k in (0, 1):  # whatever is differentiated
        with pytest.warns(RuntimeWarning, match="reversal lost digits"):
            slope(None, k).block_until_ready()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope(100, 0).block_until_ready()


@pytest.mark.parametrize("mass", [1.0, 2.0**40])
def test_the_unit_of_mass_of_a_top_released_at_rest_does_not_matter(mass):
    """With 1 as the unit of its momentum the heavy one was 0.003 from its start, and a warning said so."""

    def made(w):
        top = li.systems.heavy_top(mass * np.array([1.0, 1.5, 2.0]), mass * np.array([0.0, 0.0, 1.0]))
        return li.schemes.splitting(top), top.state([0.8, 0.6, 0.0, 0.0], angular_velocity=w)

    assert li.adjoints.round_trip_error(*made([0.0, 0.0, 0.0]), 0.1, 50) < 5e-15  # observed: 1.1e-15

    def last(w):
        return li.reversible(*made(w), 0.1, 50).state.q[-1, 0]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(jax.grad(last))(jnp.zeros(3)).block_until_ready()


@pytest.mark.parametrize("mass", [1.0, 2.0**-40])
def test_a_slew_from_rest_to_rest_keeps_its_digits(mass):
    """Its momenta are rounding errors at both ends: in units of these the start was 7 away, and a warning said so."""

    def law(t, q, omega):
        return mass * jnp.sin(2 * jnp.pi * t / 10) * jnp.array([0.6, 0.64, 0.48])

    def last(w):
        body = li.systems.torqued_body(mass * np.ones(3), law, frame="body")
        run = li.reversible(li.schemes.torqued_midpoint(body), body.state(angular_velocity=w), 0.1, 100)
        return run.state.q[-1, 0], run.state.p[-1]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, p = jax.jit(jax.grad(last, has_aux=True))(jnp.zeros(3))
    assert np.abs(p).max() < 1e-13 * mass  # at rest, as said


@pytest.mark.quick
def test_reverse_mode_refuses_forward_mode():
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda J: end(J, STATE, 0.05), (BODY.inertia,), (BODY.inertia,))
