"""One kernel for a whole loop: XLA obeys the attributes, results are the same, and what calls libraries is left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax._numerics import kernel, three
from lieint_jax.ensemble import _job

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATES = jax.vmap(lambda w: BODY.state(angular_velocity=w))(jnp.asarray(np.random.default_rng(0).normal(size=(70, 3))))


def squares(n, x):
    return jax.lax.fori_loop(0, n, lambda _, x: kernel.stored(jnp.sin(x) + x * x), x)


def test_xla_keeps_the_call_whole():
    x = jnp.linspace(0.1, 0.5, 64)
    whole = jax.jit(kernel.one_kernel(squares)).lower(3, x).compile()
    assert 'xla_cpu_small_call="true"' in whole.as_text()
    entry = whole.as_text().split("ENTRY")[1]
    assert " call(" in entry
    assert " while(" not in entry  # the loop is within the call
    assert " while(" in jax.jit(squares).lower(3, x).compile().as_text().split("ENTRY")[1]
    np.testing.assert_allclose(whole(3, x), jax.jit(squares)(3, x), rtol=1e-15)


def test_it_can_be_turned_off(monkeypatch):
    x = jnp.linspace(0.1, 0.5, 64)
    monkeypatch.setenv(kernel.SWITCH, "0")
    assert "xla_cpu_small_call" not in jax.jit(kernel.one_kernel(squares)).lower(3, x).as_text()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [li.schemes.so3_midpoint, li.schemes.so3_explicit])
def test_an_ensemble_is_what_it_is_without(scheme, monkeypatch):
    step = scheme(BODY)
    whole = li.ensemble.run(step, STATES, 0.05, 30, save_every=10, progress=False)
    monkeypatch.setenv(kernel.SWITCH, "0")
    plain = li.ensemble.run(step, STATES, 0.05, 30, save_every=10, progress=False)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-15)  # observed: 4e-16


def test_the_first_failure_is_found():
    """Bodies that hang from a heavy point fall faster than the scheme can turn, each after its own number of steps."""
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [0.0, 0.0, 12.0])
    step, dt = li.schemes.splitting(top), 0.2
    slow = 0.1 * jnp.asarray(np.random.default_rng(1).normal(size=(70, 3)))
    states = jax.vmap(lambda w: top.state(angular_velocity=w))(slow)
    with pytest.warns(RuntimeWarning, match="did not converge at every step"):
        run = li.ensemble.run(step, states, dt, 40, save_every=4, reduce="energy", progress=False)
    each = jax.vmap(lambda z: li.integrate(step, z, dt, 40, 1).info.converged)(states)[:, 1:]
    first = np.where(np.all(each, axis=1), -1, np.argmin(each, axis=1))
    assert len(set(first.tolist())) > 2
    np.testing.assert_array_equal(run.failed, first)
    failing = np.sum(~np.asarray(each).reshape(70, 10, 4).all(axis=2), axis=0)
    np.testing.assert_array_equal(run.unconverged[1:4], failing[:3])  # later, what has failed is chaos


@pytest.mark.long
def test_members_that_start_apart_keep_their_times(monkeypatch):
    """256 members are two parts of a block; each part has the times of its own members."""
    body = li.systems.gravity_gradient([1.0, 2.0, 2.9], li.orbits.kepler(1.0, 1.0, 0.3))
    step, at = li.schemes.splitting(body), jnp.linspace(0.0, 3.0, 256)
    states = jax.vmap(lambda t: body.state(angular_velocity=[0.1, 0.2, 0.3], t=t))(at)
    whole = li.ensemble.run(step, states, 0.05, 4, progress=False)
    monkeypatch.setenv(kernel.SWITCH, "0")
    plain = li.ensemble.run(step, states, 0.05, 4, progress=False)
    np.testing.assert_array_equal(whole.state.t[-1], at + 4 * 0.05)
    assert len(set(np.asarray(whole.state.q[-1, :, 0]).tolist())) == 256
    for one, other in zip(jax.tree.leaves(whole.state), jax.tree.leaves(plain.state), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-15)  # observed: 2e-16


@li.pytree
class Products:
    """Ṽ(Γ) = ½ Γ·AΓ, by a matrix product, which is a call of a library."""

    A: jax.Array

    def __call__(self, Gamma):
        return 0.5 * Gamma @ self.A @ Gamma


def test_what_calls_a_library_is_not_in_a_kernel():
    top = li.systems.potential_top([1.0, 2.0, 2.5], Products(jnp.diag(jnp.array([0.1, 0.2, 0.4]))), [0.0, 0.0, 1.0])
    step = li.schemes.splitting(top)
    assert step.one_kernel
    assert not kernel.suits(step, top.state(angular_velocity=[0.1, 0.2, 0.3]), 0.05)
    for scheme in (li.schemes.so3_midpoint, li.schemes.gauss):  # the latter multiplies matrices elsewhere
        assert kernel.suits(scheme(BODY), BODY.state(angular_velocity=[0.1, 0.2, 0.3]), 0.05)
    states = jax.vmap(lambda w: top.state(angular_velocity=w))(jnp.eye(3))
    ends = li.ensemble.run(step, states, 0.05, 20, progress=False)
    alone = jax.vmap(lambda z: li.integrate(step, z, 0.05, 20, 20))(states)
    np.testing.assert_allclose(ends.state.q[-1], alone.state.q[:, -1], rtol=0, atol=1e-14)


def test_the_question_is_asked_once(monkeypatch):
    step, asked = li.schemes.so3_midpoint(li.systems.rigid_body([1.0, 2.0, 2.9])), []
    monkeypatch.setattr(_job, "_suited", {})
    monkeypatch.setattr(kernel, "suits", lambda *arguments: asked.append(arguments) or True)
    for _ in range(2):
        li.ensemble.run(step, STATES, 0.05, 2, progress=False)
    assert len(asked) == 1


@kernel.together
def pendulum(J, weight, q, p):
    """A vector field of six numbers, written with arrays."""
    Gamma, Omega = jnp.stack(q), jnp.sum(jnp.asarray([[1.0, 2, 3], [4, 5, 6], [7, 8, 10]]) * jnp.stack(p), axis=1) / J
    return three.components(jnp.cross(Gamma, Omega)), three.components(jnp.sin(Gamma) * weight)


def euler(field, weight_axis=None):
    """Some steps of many members: a loop, within which alone functions are put together."""
    each = jax.vmap(field, (None, weight_axis, 0, 0))

    def loop(J, weight, q, p):
        def one(_, z):
            return jax.tree.map(lambda x, f: x + 0.01 * f, z, each(J, weight, *z))

        return jax.lax.fori_loop(0, 5, one, (q, p))

    return loop


def pendula(*shape):
    J = jnp.asarray([10.0, 20.0, 30.0])
    q, p = np.random.default_rng(2).normal(size=(2, 3, *shape))
    return J, jnp.asarray(0.7), tuple(map(jnp.asarray, q)), tuple(map(jnp.asarray, p))


def assert_same_in_a_kernel(function, *arguments, loops):
    """As without a kernel, and with so many loops for several results."""
    whole = jax.jit(kernel.one_kernel(function)).lower(*arguments).compile()
    assert whole.as_text().count(" reduce-window(") == loops
    plain = jax.jit(function).lower(*arguments).compile()
    assert "reduce-window" not in plain.as_text()
    for one, other in zip(jax.tree.leaves(whole(*arguments)), jax.tree.leaves(plain(*arguments)), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=0, atol=4e-15)  # observed: 9e-16


def test_several_results_come_of_one_loop():
    assert_same_in_a_kernel(euler(pendulum), *pendula(64), loops=1)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(64,), (3, 32)])
def test_members_may_have_what_others_share(shape):
    """A weight each; and members in stages, where an argument may have either axis."""
    J, _, q, p = pendula(*shape)
    weights = jnp.linspace(0.5, 1.5, shape[0])
    inner = euler(pendulum, 0)
    if len(shape) == 1:
        assert_same_in_a_kernel(inner, J, weights, q, p, loops=1)
    else:
        assert_same_in_a_kernel(jax.vmap(euler(pendulum), (None, 0, 0, 0)), J, weights, q, p, loops=1)


def test_its_derivatives_are_those_of_the_function():
    J, weight, q, p = pendula(16)
    along = jax.tree.map(jnp.cos, (J, weight, q, p))
    assert_same_in_a_kernel(lambda *x: jax.jvp(euler(pendulum), x[:4], x[4:]), J, weight, q, p, *along, loops=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["too many numbers", "no arithmetic", "two types", "no member in it"])
def test_what_cannot_be_one_loop_is_called_as_it_is(kind):
    count = 12 if kind == "too many numbers" else 4

    def function(x):
        if kind == "too many numbers":
            return tuple(a * b for a, b in zip(x, reversed(x), strict=True))
        if kind == "no arithmetic":
            return (jax.lax.fori_loop(0, 2, lambda _, y: y * x[1], x[0]), *x[1:])
        if kind == "no member in it":
            return (jnp.ones(()),) * count
        return (x[0] * x[1], *x[2:], x[0] > x[1])

    members = jax.vmap(kernel.together(function))

    def loop(x):
        return jax.lax.fori_loop(0, 3, lambda _, x: tuple(jnp.asarray(y, x[0].dtype) for y in members(x)), x)

    x = tuple(jnp.asarray(np.random.default_rng(3).normal(size=(count, 32))))
    assert_same_in_a_kernel(loop, x, loops=0)
