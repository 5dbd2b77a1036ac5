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
from lieint_jax.core import State

pytestmark = pytest.mark.long

GRID = {name: rest for name, *rest in steps() if rest[0].symmetric}  # others cannot be undone


BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = BODY.state(angular_velocity=[0.2, 0.3, 1.0])
STEP = li.schemes.so3_midpoint(BODY)


ADJOINTS = {"reversible": li.ReversibleAdjoint(), "checkpoint": li.RecursiveCheckpointAdjoint(), "loop": None}
UNDO, STORE, _ = ADJOINTS.values()


def end(J, state, dt, num_steps=40):
    step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
    return li.integrate(step, state, dt, num_steps, save_every=num_steps, adjoint=UNDO).state.q[-1, 0]


def test_the_trajectory_is_that_without_an_adjoint():
    ours, theirs = (li.integrate(STEP, STATE, 0.05, 12, save_every=4, adjoint=a) for a in (UNDO, None))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
    assert li.integrate(STEP, STATE, 0.05, 0, adjoint=UNDO).t.shape == (1,)


def test_batches_of_states_and_of_parameters():
    J = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.5, 2.8]])
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.array([[0.2, 0.3, 1.0], [0.5, -0.3, 0.2]]))
    both = jax.jit(jax.vmap(jax.grad(end), (0, 0, None)))(J, states, 0.05)
    alone = [jax.jit(jax.grad(end))(J[k], State(states.q[k], states.p[k]), 0.05) for k in (0, 1)]
    np.testing.assert_allclose(both, jnp.stack(alone), rtol=1e-12)


def test_functions_of_a_step_may_close_over_what_is_differentiated():
    def bent(c, adjoint):
        step = li.schemes.so3_midpoint(BODY, lambda x: 1 + c * x)
        return li.integrate(step, STATE, 0.5, 8, save_every=8, adjoint=adjoint).state.q[-1, 0]

    slopes = [jax.jit(jax.grad(lambda c, a=a: bent(c, a)))(0.3) for a in (UNDO, None)]
    assert slopes[0] == pytest.approx(float(slopes[1]), rel=1e-12, abs=0)
    assert abs(slopes[0]) > 1e-6


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
def test_a_run_of_zero_steps_has_the_derivative_of_the_identity(adjoint):
    def end(q):
        return li.integrate(STEP, State(q, STATE.p), 0.05, 0, adjoint=adjoint).state.q[-1, 1]

    np.testing.assert_array_equal(jax.grad(end)(STATE.q), [0, 1, 0, 0])


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
@pytest.mark.parametrize("times", [[], [0.0, 0.0]])
def test_observations_of_no_time_and_at_the_start(times, adjoint):
    def seen(q):
        return li.integrate(STEP, State(q, STATE.p), 0.05, save_at=np.array(times), adjoint=adjoint).state.q[1:]

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
    forward = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: last(x, STORE))))(at)
    np.testing.assert_allclose(jax.jit(jax.hessian(lambda x: last(x, UNDO)))(at), forward, rtol=1e-11, atol=1e-12)


def temporaries(make, num_steps):
    def last(J, states):
        step = make(li.schemes.so3_midpoint(li.systems.RigidBody(J)))

        def end(state):
            return li.integrate(step, state, 0.05, num_steps, save_every=num_steps, adjoint=UNDO).state.q[-1, 0]

        return jnp.sum(jax.vmap(end)(states))

    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.ones((100, 3)))
    return jax.jit(jax.grad(last)).lower(BODY.inertia, states).compile().memory_analysis().temp_size_in_bytes


def test_memory_does_not_grow_with_the_number_of_steps():
    assert temporaries(lambda step: step, 40_000) <= temporaries(lambda step: step, 40) + 64


def test_a_composition_is_undone_in_the_memory_of_its_base_step():
    """It has 19 sub-steps."""
    assert temporaries(lambda step: li.schemes.compose(step, 8), 40) <= 1.5 * temporaries(lambda step: step, 40)


def test_observations_at_any_times():
    """The exact flow takes whole and shorter steps alike, so any times must be met to round-off, in any order."""
    exact = li.schemes.exact(BODY)
    times = jnp.array([0.33, 0.0, 1.0, 0.05, 0.071, 0.33])
    for adjoint in ADJOINTS.values():
        for sign in (1, -1):
            seen = li.integrate(exact, STATE, sign * 0.05, save_at=sign * times, adjoint=adjoint)
            true = jax.vmap(BODY.solution, (None, 0), State(0, None))(STATE, sign * times)
            np.testing.assert_allclose(seen.state.q[1:], true.q, rtol=0, atol=1e-14)
            np.testing.assert_array_equal(seen.t, [0, *(sign * times)])
            assert seen.info.converged.all()


def test_traced_times_that_are_not_reached_are_flagged_and_harm_no_other():
    seen = jax.jit(lambda dt, t: li.integrate(STEP, STATE, dt, save_at=t, adjoint=UNDO))
    found = seen(0.05, jnp.array([-0.5, 0.5, 0.52]))
    assert found.info.converged.tolist() == [True, False, True, True]
    end = li.integrate(STEP, STATE, 0.05, 10, save_every=10).state.q[-1]
    np.testing.assert_allclose(found.state.q[2], end, rtol=0, atol=1e-14)
    assert not seen(0.0, jnp.array([0.5, 0.5, 0.5])).info.converged[1:].any()


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
        return weights @ li.integrate(composed(x[0]), start, x[1], save_at=x[2:], adjoint=UNDO).state.q[1:, 0, 0]

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
        step = TimedLeapfrog(Oscillators(x[0]))
        return jnp.sum(li.integrate(step, start, x[1], save_at=x[3:], adjoint=UNDO).state.q[1:, 0, 0])

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
    run = li.integrate(run_step, start, 0.1, 6, save_every=2, adjoint=STORE)
    np.testing.assert_allclose(run.state.t, [0.3, 0.5, 0.7, 0.9], rtol=1e-15)
    start, times = start._replace(p=jnp.ones((3, 3))), [0.7, 0.9, 0.45]
    seen, undone = (li.integrate(run_step, start, 0.1, save_at=times, adjoint=a).state for a in (STORE, UNDO))
    np.testing.assert_array_equal(seen.t, [0.3, *times])
    np.testing.assert_array_equal(undone.t, seen.t)
    np.testing.assert_allclose(seen.q, undone.q, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("adjoint", [UNDO, STORE], ids=["reversible", "checkpoint"])
def test_the_run_and_the_gradient_of_an_adjoint_are_those_of_the_loop(adjoint):
    step, start = Leapfrog(Oscillators(jnp.array(1.3))), State(jnp.eye(3), jnp.ones((3, 3)), jnp.array(0.3))
    weights = jnp.arange(4.0)[:, None, None]

    def loss(adjoint, start):
        path = li.integrate(step, start, 0.1, 6, save_every=2, adjoint=adjoint)
        return jnp.sum(path.state.q * path.state.p * weights), path

    both = (jax.jit(jax.grad(functools.partial(loss, a), has_aux=True))(start) for a in (adjoint, None))
    for x, y in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-13)


@pytest.mark.quick
def test_checkpoints_of_steps_between_given_times():
    times = jnp.array([0.3, 0.4, 0.55, 0.6, 0.9, 1.0, 1.02])

    def loss(q, **options):
        start = State(q, jnp.ones((3, 3)), jnp.array(0.3))
        run = li.integrate(Leapfrog(Oscillators(jnp.array(1.3))), start, times=times, save_every=3, **options)
        return jnp.sum(run.state.q**3)

    expected = jax.jit(jax.grad(loss))(jnp.eye(3))
    found = jax.jit(jax.grad(functools.partial(loss, adjoint=STORE)))(jnp.eye(3))
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(("name", "sign"), [("free", 1), ("free", -1), ("driven", 1), ("driven", -1)])
def test_derivatives_of_states_at_given_times_by_everything(name, sign):
    """Times in any order, one twice, one at a node. Reverse mode in three ways, forward mode, and differences.

    Differences change dt, the times and the numbers of the step and the state; where an output is at a node, the
    derivative by dt is that of one side, so that the node's time moves along with it there.
    """
    rng = np.random.default_rng(3)
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    step, state = li.schemes.so3_explicit(body), STATE  # its `prepare` depends on everything
    if name == "driven":  # by a law of the time, with work
        orbit = li.orbits.kepler(1.0, 1.0, 0.2)
        body = li.systems.gravity_gradient([0.6, 0.9, 1.0], orbit)
        step = li.schemes.splitting(body)
        state = body.state(angular_velocity=[0.2, 0.3, 1.0], t=0.3, work=0.0)
    leaves, structure = jax.tree.flatten(step)
    t0 = jnp.asarray(0.0) if state.t is None else state.t
    times = t0 + sign * jnp.array([0.33, 1.02, 0.071, 0.33, 0.0, 0.4])
    weights = [jnp.asarray(rng.normal(size=(7, *x.shape))) for x in jax.tree.leaves(state)]

    def loss(adjoint, leaves, state, dt, times):
        run = li.integrate(structure.unflatten(leaves), state, dt, 30, save_at=times, adjoint=adjoint)
        return sum(jnp.sum(w * x) for w, x in zip(weights, jax.tree.leaves(run.state), strict=True))

    at = (leaves, state, jnp.asarray(sign * 0.05), times)
    by = {key: jax.jit(jax.grad(functools.partial(loss, a), argnums=(0, 1, 2, 3)))(*at) for key, a in ADJOINTS.items()}
    for other in ("reversible", "checkpoint"):
        for x, y in zip(*map(jax.tree.leaves, (by[other], by["loop"])), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12)
    along = jax.tree.map(lambda x: jnp.asarray(0.1 * rng.normal(size=jnp.shape(x))), at)
    # the start and the node of 8 steps stay where they are on the clock
    along = (*along[:3], along[3].at[4].set(0).at[5].set(8 * along[2]))
    if state.t is not None:
        along = (along[0], along[1], along[2], along[3] + jnp.zeros(6).at[jnp.array([4, 5])].set(along[1].t))
    space = body.phase_space
    delta = space.trivialize(state, along[1])  # a tangent vector: the attitude stays a unit quaternion

    def moved(h):
        x = jax.tree.map(lambda x, d: x + h * d, at, along)
        return (x[0], space.perturb(state, h * delta)._replace(t=x[1].t, work=x[1].work), *x[2:])

    value = jax.jit(lambda h: loss(None, *moved(h)))
    forward = jax.jit(lambda: jax.jvp(lambda h: loss(None, *moved(h)), (0.0,), (1.0,))[1])()
    _, tangents = jax.jvp(moved, (0.0,), (1.0,))
    reverse = sum(jnp.vdot(x, y) for x, y in zip(*map(jax.tree.leaves, (by["reversible"], tangents)), strict=True))
    assert float(reverse) == pytest.approx(float(forward), rel=1e-11, abs=0)
    h = 1e-4
    slope = (value(-2 * h) - 8 * value(-h) + 8 * value(h) - value(2 * h)) / (12 * h)
    assert float(slope) == pytest.approx(float(forward), rel=1e-7)
    assert abs(forward) > 1e-2


@pytest.mark.quick
@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
def test_a_traced_time_outside_the_run_does_not_harm_gradients(adjoint):
    """With a NaN in the output times, and one on the wrong side of the start, gradients by the others are NaN-free."""

    def loss(x, times):
        start = State(jnp.eye(3), jnp.ones((3, 3)))
        run = li.integrate(Leapfrog(Oscillators(x)), start, 0.1, 9, save_at=times, adjoint=adjoint)
        return jnp.sum(jnp.where(run.info.converged[:, None, None], run.state.q, 0) ** 3), run.info.converged

    slope = jax.jit(jax.grad(loss, has_aux=True))
    found, converged = slope(1.3, jnp.array([0.7, jnp.nan, 0.33, -1e3, 0.91]))
    assert converged.tolist() == [True, True, False, True, False, False]
    assert float(found) == pytest.approx(float(slope(1.3, jnp.array([0.33, 0.7]))[0]), rel=1e-13, abs=0)


def test_round_trips_are_measured_and_lost_digits_draw_a_warning():
    """A chaotic top comes back less and less; a gradient over that time says so, unless states are saved in between."""
    step, state, dt = GRID["heavy_top.asymmetric_top-splitting[so3_midpoint[symplectic]]"]
    trip = jax.jit(li.diagnostics.round_trip_error, static_argnums=3)
    assert trip(step, state, dt, 100) < 1e-13  # 2e-14
    lost = trip(step, state, dt, 4000)
    assert lost > 1e-9  # the largest Lyapunov exponent is 0.086: e^(0.086 · 200) = 3e7

    def slope(save_every, k):
        def last(dt, p):
            return li.integrate(step, State(state.q, p), dt, 4000, save_every, adjoint=UNDO).state.q[-1, 0]

        return jax.jit(jax.grad(last, argnums=k))(jnp.asarray(dt), state.p)

    for k in (0, 1):  # whatever is differentiated
        with pytest.warns(RuntimeWarning, match="reversal lost digits"):
            slope(4000, k).block_until_ready()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope(100, 0).block_until_ready()


@pytest.mark.parametrize("mass", [1.0, 2.0**40])
def test_the_unit_of_mass_of_a_top_released_at_rest_does_not_matter(mass):
    """With 1 as the unit of its momentum the heavy one was 0.003 from its start, and a warning said so."""

    def made(w):
        top = li.systems.heavy_top(mass * np.array([1.0, 1.5, 2.0]), mass * np.array([0.0, 0.0, 1.0]))
        return li.schemes.splitting(top), top.state([0.8, 0.6, 0.0, 0.0], angular_velocity=w)

    assert li.diagnostics.round_trip_error(*made([0.0, 0.0, 0.0]), 0.1, 50) < 5e-15  # observed: 1.1e-15

    def last(w):
        return li.integrate(*made(w), 0.1, 50, save_every=50, adjoint=UNDO).state.q[-1, 0]

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
        step, start = li.schemes.torqued_midpoint(body), body.state(angular_velocity=w)
        run = li.integrate(step, start, 0.1, 100, save_every=100, adjoint=UNDO)
        return run.state.q[-1, 0], run.state.p[-1]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, p = jax.jit(jax.grad(last, has_aux=True))(jnp.zeros(3))
    assert np.abs(p).max() < 1e-13 * mass  # at rest, as said


@pytest.mark.quick
def test_reverse_mode_refuses_forward_mode():
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda J: end(J, STATE, 0.05), (BODY.inertia,), (BODY.inertia,))
