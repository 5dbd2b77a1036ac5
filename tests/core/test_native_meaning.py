"""Programs of numbers mean what XLA's do: booleans, parameters of primitives, what is not finite, and unknown types."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

pytest.importorskip("llvmlite")

from kernels import Kernel
from native_members import MEMBERS, check_against_jax, compiled, member_shape

import lieint_jax as li
from lieint_jax.native import UnsupportedError
from lieint_jax.native._program import Builder
from lieint_jax.native._walk import Walk

RNG = np.random.default_rng(0)
J = np.array([1.0, 2.0, 2.5])


def test_products_of_booleans_are_and_and_sums_or():
    def function(x, y):
        both = jnp.array([True, True, False])
        found = {"dot": x[0] @ both, "matrix": x @ y.T, "batch": jnp.einsum("ij,ij->i", x, y), "square": x @ x.T}
        found |= {"counted": lax.dot(x, y.T, preferred_element_type=np.int32), "nothing": x[:, :0] @ y[:, :0].T}
        found |= {"most": x.max(1), "least": x.min(0), "first": x.argmax(1)}
        return found | {"set": x.at[0].max(y[1]), "and": x.at[:, 1].min(y[0, 0])}

    x, y = RNG.integers(0, 2, (2, MEMBERS, 2, 3)).astype(bool)
    x[0] = y[0] = True  # an even number of true terms, and an odd one
    check_against_jax(function, (x, y))


def test_a_scatter_has_the_function_that_it_names():
    def function(x, k):
        found = {"apply": x.at[1].apply(jnp.cos), "some": x.at[k].apply(lambda y: y * 2 + 1)}
        return found | {"own": jax.vmap(lambda row, n: row.at[n].apply(jnp.square))(x, k)}

    check_against_jax(function, (RNG.normal(size=(MEMBERS, 2, 3)), RNG.integers(0, 2, (MEMBERS, 2))), rtol=1e-14)


def test_a_reshape_may_be_by_columns():
    def function(x):
        return {"columns": x.reshape(6, order="F"), "of": lax.reshape(x, (3, 2), (1, 0)), "ravel": x.ravel("F")}

    check_against_jax(function, [RNG.normal(size=(MEMBERS, 2, 3))])


def test_choices_and_indices_beyond_the_last_are_those_of_jax():
    def function(k, u, x):
        chosen = lax.select_n(k, x, x + 1, x + 2)
        modes = [x.at[u].get(mode=mode) for mode in ("clip", "fill")]
        return chosen, lax.dynamic_slice(x, (u,), (2,)), modes, x.at[u].add(1, mode="clip")

    k = np.stack([np.arange(MEMBERS, dtype=np.int32) - 5] * 3, 1)
    u = np.arange(MEMBERS, dtype=np.uint64)
    u[1::2] += np.uint64(2**63)
    check_against_jax(function, (k, u, RNG.normal(size=(MEMBERS, 3))))


def test_a_constant_0_drops_nothing():
    """0·∞ and 0/0 are NaN, and zeros have the signs of XLA."""

    def function(x, k):
        found = {"product": 0.0 * x, "quotient": 0.0 / x, "negative": -0.0 * x, "difference": 0.0 - x, "none": x - 0.0}
        found |= {"sum": x + 0.0, "less": x - -0.0, "once": 1.0 * x, "minus": -1.0 * x, "whole": 0 * k + k // 1 + 0}
        row = jnp.array([0.0, 1.0])
        return found | {"dot": row @ jnp.stack([x, x * 0 + 1]), "slope": jax.grad(lambda x: 0 * jnp.sqrt(x))(x)}

    x = np.resize([0.0, -0.0, np.inf, -np.inf, np.nan, 1.5, -2.5], MEMBERS)
    check_against_jax(function, (x, np.arange(MEMBERS)), signs=True)


@pytest.mark.long
def test_a_verdict_sees_what_is_multiplied_by_0():
    """The gradient of 0·log Γ₁ is 0/0 at Γ₁ = 0."""
    top = li.systems.potential_top(J, lambda axis: 0.1 * axis[2] + 0.0 * jnp.log(axis[0]))
    step, states = li.schemes.splitting(top), jax.vmap(lambda w: top.state(angular_velocity=w))(jnp.eye(3))
    _, verdicts = jax.jit(jax.vmap(lambda z: step(z, 0.1)))(states)
    _, info = compiled(lambda z: step(z, 0.1), [states])([states])
    np.testing.assert_array_equal(info.converged, verdicts.converged)
    assert not info.converged.all()


X, K = jnp.ones((2, 2)), jnp.array([0, 1])
UNKNOWN = {
    "bfloat16": lambda x: x.astype(jnp.bfloat16).sum(),
    "a gather of bfloat16": lambda x: jnp.arange(4, dtype=jnp.bfloat16).at[x[0, 0].astype(int)].get(mode="fill"),
    "float16": lambda x: x.astype(jnp.float16),
    "float8": lambda x: x.astype(jnp.float8_e4m3fn),
    "int4": lambda x: x.astype(jnp.int4),
    "complex": lambda x: jnp.abs(x + 1j),
    "key": lambda x: x + jax.random.normal(jax.random.key(1), (2, 2)),
    "precision": lambda x: lax.dot(*[x.astype(np.float32)] * 2, precision=lax.DotAlgorithmPreset.BF16_BF16_F32),
    "mantissa": lambda x: lax.reduce_precision(x, 8, 23),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_unknown_types_and_parameters_are_not_supported(name):
    with pytest.raises(UnsupportedError):
        Kernel(UNKNOWN[name], ["member"], [member_shape(np.zeros((MEMBERS, 2, 2)))])


PRIMITIVES = {
    "elementwise": lambda x, k: jnp.exp(x),
    "reduction": lambda x, k: lax.reduce_sum(x, (0,)),
    "index": lambda x, k: lax.dynamic_slice(x, (k[0], k[1]), (1, 1)),
    "move": lambda x, k: x.T,
}


@pytest.mark.parametrize("name", PRIMITIVES)
def test_a_formula_names_all_parameters_that_it_knows(name):
    """A later release may add one that changes values: unless it is None, XLA runs the function."""
    closed = jax.make_jaxpr(PRIMITIVES[name])(X, K)
    for value in (None, True):
        equations = [e.replace(params=e.params | {"new": value}) for e in closed.jaxpr.eqns]
        walk = Walk(Builder(), lambda *_: None)
        inputs = [walk.constant_array(x, x.dtype) for x in (X, K)]
        if value is None:
            assert len(walk.jaxpr(closed.jaxpr.replace(eqns=equations), inputs)) == 1
        else:
            with pytest.raises(TypeError, match="new"):
                walk.jaxpr(closed.jaxpr.replace(eqns=equations), inputs)


KEY, NARROW = jax.random.key(2), jnp.array([0.25, 0.5], jnp.bfloat16)
DRAWS = {
    "made": lambda: jax.random.normal(jax.random.key(1), (3,)),
    "closed over": lambda: jax.random.normal(KEY, (3,)),
    "raw": lambda: jax.random.normal(jax.random.PRNGKey(1), (3,)),
    "narrow": lambda: NARROW.at[jnp.array([0, 1, 1])].get(mode="fill").astype(float),
}


def assert_members_run_as_one(step, state):
    one = li.integrate(step, state, 0.1, 5)
    run = li.run(step, jax.tree.map(lambda x: np.asarray(x)[None], state), 0.1, 5, progress=False, save_every=None)
    np.testing.assert_allclose(run.state.p[-1, 0], one.state.p[-1], rtol=1e-13)


@pytest.mark.long
@pytest.mark.parametrize("name", DRAWS)
@pytest.mark.parametrize("kind", ["potential", "law"])
def test_random_numbers_and_narrow_ones_give_the_same_run_to_members(kind, name):
    draw = DRAWS[name]
    if kind == "law":
        body = li.systems.torqued_body(J, lambda t, q, w: 0.1 * draw() - 0.1 * w)
        step, state = li.schemes.torqued_midpoint(body), body.state(angular_velocity=[0.7, -1.0, 1.3], t=0.0)
    else:
        top = li.systems.potential_top(J, lambda axis: axis @ draw())
        step, state = li.schemes.splitting(top), top.state(angular_velocity=[0.7, -1.0, 1.3])
    assert_members_run_as_one(step, state)


@pytest.mark.long
def split_by_key(key):
    def potential(key, axis):
        return axis @ jax.random.normal(key, (3,))

    return li.schemes.splitting(li.systems.potential_top(J, jax.tree_util.Partial(potential, key)))


def test_a_step_may_have_a_key_among_its_arrays(caplog):
    step = split_by_key(KEY)
    assert_members_run_as_one(step, step.system.state(angular_velocity=[0.7, -1.0, 1.3]))
    assert "an argument of type key<fry>" in caplog.text


def test_each_member_may_have_a_key_of_its_own():
    keys = jax.random.split(KEY, 3)
    steps = jax.vmap(split_by_key)(keys)
    states = jax.vmap(lambda w: split_by_key(KEY).system.state(angular_velocity=w))(np.eye(3))
    run = li.run(steps, states, 0.1, 5, own_step=True, progress=False)
    for k in range(3):
        one = li.integrate(split_by_key(keys[k]), jax.tree.map(lambda x: x[k], states), 0.1, 5)  # noqa: B023
        np.testing.assert_allclose(run.state.p[:, k], one.state.p, rtol=0, atol=3e-16)  # observed: 3e-17
    assert np.abs(run.state.p[-1] - run.state.p[0]).max(axis=1).min() > 1e-3
    assert run.energy_error().shape == (6, 3)
