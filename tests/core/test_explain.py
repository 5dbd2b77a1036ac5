"""`li.explain`: which engine runs a loop; and that what should be fast is machine code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("llvmlite")

import lieint_jax as li
from lieint_jax import orbits

J = np.array([1.0, 2.0, 2.5])
W = jnp.array([[0.3, 0.2, 1.0], [0.1, -0.2, 0.9]])


def logistic(x):
    return li.scan(lambda x, _: (3.2 * x * (1 - x), None), x, length=100)[0]


def test_a_loop_of_a_function_is_explained():
    found = li.explain(jax.vmap(logistic), jax.ShapeDtypeStruct((1000,), np.float64))
    [loop] = found.loops
    assert (loop.kind, loop.reverse, loop.steps, loop.members) == ("values", False, 100, 1000)
    assert (loop.engine, loop.reason, loop.operations) == ("native", "", 3)
    assert loop.lanes >= 2
    assert set(loop.seconds) == {"walk", "llvm"}
    assert found.engines == {"native"}
    assert (len(found), list(found), found[0]) == (1, [loop], loop)
    assert "values: 100 steps, members 1000, native, operations 3" in str(found)
    with li.engine("xla"):
        [loop] = li.explain(logistic, 0.3).loops
        assert (loop.engine, loop.reason) == ("xla", "chosen by li.engine or LIEINT_ENGINE")


def test_pieces_and_rest_of_a_gradient_are_the_same_machine_code():
    def end(x):  # 13 pieces of 15 steps and a rest of 5, whose last result is the carry
        return li.scan(lambda x, _: ((y := 3.2 * x * (1 - x)), y), x, length=200, every=200)[1][0]

    loops = li.explain(jax.grad(end), 0.3).loops
    assert {loop.steps for loop in loops} == {5, 15}
    assert len({(loop.reverse, loop.operations) for loop in loops}) == 2, loops


def test_pieces_and_rest_of_a_run_with_time_are_the_same_machine_code():
    """The time follows from the number of steps: it is no result of the loop, which would be that of the rest only."""
    body = li.systems.RigidBody(J)

    def end(w):
        state = body.state(angular_velocity=w)._replace(t=jnp.zeros(()))
        return li.integrate(li.schemes.so3_midpoint(body), state, 0.05, 200, save_every=200).state

    assert end(W[0]).t[-1] == 10.0
    loops = li.explain(jax.grad(lambda w: end(w).q[-1, 0]), W[0]).loops
    assert {loop.steps for loop in loops} == {5, 15}
    assert len({(loop.reverse, loop.operations) for loop in loops}) == 2, loops


def test_loops_that_xla_runs_are_explained():
    def mixed(x):
        y, _ = jax.lax.scan(lambda x, _: (x / 2, None), x, None, length=3)
        return li.scan(lambda x, _: (jnp.linalg.eigh(jnp.outer(x, x))[0], None), y, length=2)[0]

    found = li.explain(mixed, jnp.ones(2))
    assert found.others == 1
    assert found.loops[0].engine == "xla"
    assert "eigh has no formula" in found.loops[0].reason
    assert "other loops, by XLA: 1" in str(found)


def free_body(J):
    return li.schemes.so3_midpoint(li.systems.RigidBody(J)), {}


def top(J):
    return li.schemes.splitting(li.systems.heavy_top(J, np.array([0.0, 0.0, 1.0]))), {}


def nystrom(J):
    return li.schemes.nystrom(li.systems.heavy_top(J, np.array([0.0, 0.0, 1.0])), 6), {}


def satellite(J):
    laws = [li.torques.viscous(0.01), lambda t, q, w: 0.01 * jnp.cos(t) * jnp.array([0.0, 1.0, 0.5])]
    return li.schemes.torqued_midpoint(li.systems.torqued_body(J, li.torques.total(laws))), {"t": 0.0, "work": 0.0}


def end(make, J, w, **options):
    step, more = make(J)
    start = step.system.state(angular_velocity=w, **more)
    return li.integrate(step, start, 0.05, 12, **({"save_every": 12} | options)).state.p[-1]


@li.pytree
class Heun(li.core.Step):
    """A user's scheme."""

    system: object

    order, symmetric, name = 2, False, "Heun"

    def advance(self, state, dt):
        def at(rate, h):
            return state._replace(q=state.q + h * rate.q, p=state.p + h * rate.p)

        first = self.system.vector_field(state)
        second = self.system.vector_field(at(first, dt))
        mean = jax.tree.map(lambda x, y: (x + y) / 2, first, second)
        return at(mean, dt), li.core.StepInfo(jnp.zeros_like(dt), jnp.asarray(True))


def heun(J):
    return Heun(li.systems.RigidBody(J)), {}


def network(J):
    eqx = pytest.importorskip("equinox")
    return li.schemes.splitting(li.systems.potential_top(J, eqx.nn.MLP(3, "scalar", 8, 1, key=jax.random.key(0)))), {}


RUNS = {"free body": free_body, "heavy top": top, "satellite": satellite, "heavy top, order 6": nystrom}
USERS = {"scheme": heun, "Equinox potential": network}
USES = {
    "values": lambda run: jax.vmap(run, (None, 0)),
    "one tangent": lambda run: lambda J, W: jax.jvp(lambda J: jax.vmap(run, (None, 0))(J, W), (J,), (J,))[1],
    "gradient": lambda run: jax.grad(lambda J, W: jax.vmap(run, (None, 0))(J, W).sum()),
}
CASES = [
    pytest.param(name, use, marks=[] if name == "free body" else [pytest.mark.long])
    for name in RUNS | USERS
    for use in USES
]


@pytest.mark.parametrize(("name", "use"), CASES)
def test_runs_and_their_derivatives_are_machine_code(name, use):
    found = li.explain(USES[use](lambda J, w: end((RUNS | USERS)[name], J, w)), J, W)
    assert found.engines == {"native"}, str(found)
    assert any(loop.reverse for loop in found.loops) == (use == "gradient")


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_runs_with_output_times_are_machine_code(name):
    """They were XLA's, since they recorded into an array that the loop carried."""

    def last(J, w):
        return end(RUNS[name], J, w, save_every=1, save_at=np.array([0.0, 0.07, 0.1, 0.1, 0.52]))

    for f in last, jax.jacfwd(last), jax.grad(lambda J, w: last(J, w).sum()):
        found = li.explain(f, J, W[0])
        assert found.engines == {"native"}, str(found)


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_gradients_by_undoing_steps_are_machine_code(name):
    adjoint = li.ReversibleAdjoint()
    gradient = jax.grad(lambda J, W: jax.vmap(lambda w: end(RUNS[name], J, w, adjoint=adjoint))(W).sum())
    assert {loop.engine for loop in li.explain(gradient, J, W).loops} == {"native"}


@pytest.mark.long
@pytest.mark.parametrize("name", ["free body", "heavy top"])
def test_exponents_and_transition_matrices_are_machine_code(name):
    step, more = RUNS[name](J)

    def exponents(w):
        start = step.system.state(angular_velocity=w, **more)
        spectrum, growth = (f(step, start, 0.05, 64) for f in (li.diagnostics.lyapunov, li.diagnostics.megno))
        return spectrum.exponents, growth.mean

    def matrix(w):
        return li.transition(step, step.system.state(angular_velocity=w, **more), 0.05, 12, save_every=4).matrix

    for f in (exponents, matrix):
        assert li.explain(jax.vmap(f), W).engines == {"native"}


@pytest.mark.slow
@pytest.mark.parametrize("axes", [(0, 0), (None, 0), (0, None)])
def test_what_does_not_change_in_a_loop_is_computed_before(axes):
    """LAPACK's eigendecomposition has no formula in machine code; all of a loop without it was XLA's."""
    inertias = np.stack([np.diag(J) + 0.1 * k * np.outer(W[0], W[1]) for k in range(3)])

    def end(inertia, x, length=20):
        def step(x, _):
            values, vectors = jnp.linalg.eigh(inertia)
            return x + 0.01 * jnp.sin(vectors @ (values * x)), None

        return jnp.sum(li.scan(step, x, length=length)[0] ** 2)

    arguments = (inertias if axes[0] == 0 else inertias[0], W[jnp.array([0, 1, 0])] if axes[1] == 0 else W[0])
    of_all = jax.vmap(jax.value_and_grad(end), axes)
    assert li.explain(of_all, *arguments).engines == {"native"}
    found = of_all(*arguments)
    with li.engine("xla"):
        expected = of_all(*arguments)
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=4e-15)


def test_members_share_an_orbit_whose_time_is_not_mapped():
    """The time was carried, one of each member, and so was the position on the orbit."""
    orbit = li.systems.gravity_gradient(J, orbits.kepler(1.0, 1.0, 0.1))
    step = li.schemes.splitting(orbit)
    states = jax.vmap(lambda w: orbit.state(angular_velocity=w, t=0.0))(W)

    def run(state):
        return li.integrate(step, state, 0.05, 40, save_every=20).state

    mapped = jax.vmap(run)
    shared = jax.vmap(run, in_axes=(li.State(0, 0, None),))
    [one], [common] = (li.explain(*x).loops for x in ((mapped, states), (shared, states._replace(t=0.0))))
    assert (one.engine, common.engine, one.shared) == ("native", "native", 0)
    assert common.shared > 0
    assert common.operations == one.operations
    found, expected = shared(states._replace(t=0.0)), mapped(states)
    np.testing.assert_allclose(found.q, expected.q, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.t, expected.t[0] if found.t.ndim == 1 else expected.t)
