"""Hints to XLA: reverse mode that computes a step once more on the way back, and forward mode in place of reverse."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lieint_jax as li
from lieint_jax._numerics import newton
from lieint_jax._numerics.stages import scan_stages
from lieint_jax._xla import (
    forward_mode,
    materialized,
    materialized_arrays,
    rematerialized,
    saved,
    with_materialized_derivatives,
)

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
TOP = li.systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])


def run(p, body, way):
    """Five implicit steps of a number, by a solver that is a loop."""

    def step(z):
        def residual(x):
            return x - z - 0.1 * jnp.sin(p * (x + z) / 2)

        def correction(x, F):
            return F / (1 - 0.05 * p * jnp.cos(p * (x + z) / 2))

        return body(newton.root(residual, correction, z, 20, done=lambda x, step: jnp.abs(step) < 1e-9)[0])

    return lax.scan(lambda z, _: (way(step)(z), None), jnp.asarray(1.0), None, length=5)[0]


PLAIN, REMATERIALIZED = (partial(run, body=lambda x: x, way=way) for way in (lambda step: step, rematerialized))


@pytest.mark.long
def test_derivatives_of_any_order_are_the_same():
    for way in (jax.grad, jax.jacfwd):
        assert float(way(REMATERIALIZED)(1.3)) == pytest.approx(float(jax.jacfwd(PLAIN)(1.3)), rel=1e-15, abs=0)
        for outer in (jax.jacfwd, jax.grad) if way is jax.jacfwd else (jax.jacfwd,):
            second = float(outer(way(REMATERIALIZED))(1.3))
            assert second == pytest.approx(float(jax.jacfwd(jax.jacfwd(PLAIN))(1.3)), rel=1e-12, abs=0)


def test_a_saved_root_is_not_computed_again():
    def loops(way):
        return jax.jit(jax.grad(partial(run, body=lambda x: x, way=way))).lower(1.3).as_text().count("while(")

    assert loops(rematerialized) == loops(lambda step: step) < loops(jax.checkpoint)


def test_stored_values_are_not_computed_again():
    def gradient(mark):
        dear = rematerialized(lambda x: mark(jnp.arctan(x)) ** 2)
        return str(jax.make_jaxpr(jax.grad(lambda x: dear(dear(x))))(0.3)).count("atan ")

    assert gradient(saved) < gradient(lambda x: x)


@pytest.mark.long
@pytest.mark.parametrize("materialize", [materialized_arrays, with_materialized_derivatives])
def test_materialized_arrays_have_the_same_values_and_derivatives_of_any_order(materialize):
    def cube(mark, x):
        return jnp.sum(mark({"x": x})["x"] ** 3)

    x = jnp.array([0.3, -1.2, 0.0])
    for way in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian, lambda f: jax.jacrev(jax.jacfwd(f))):
        marked, plain = (way(partial(cube, mark))(x) for mark in (materialize, lambda tree: tree))
        np.testing.assert_array_equal(marked, plain)


@pytest.mark.long
@pytest.mark.parametrize("step", [li.schemes.so3_midpoint(BODY), li.schemes.extrapolate(TOP)], ids=["body", "top"])
def test_a_gradient_stores_about_two_roots_of_n_states(step):
    """7 numbers of a state, 2 of a report, and the step's number; some more do not depend on the length."""
    state = step.system.state(angular_velocity=[0.3, 0.2, 1.0])

    def numbers(steps):
        run = partial(li.integrate, step, dt=0.05, num_steps=steps, save_every=steps)
        pull = jax.vjp(lambda p: run(state._replace(p=p)).state.q, state.p)[1]
        return sum(np.size(x) for x in jax.tree.leaves(pull))

    assert numbers(4096) <= 2 * 64 * 10 + 100
    assert numbers(64) > 64 * 7  # all states of so few steps


def of_stages(z, way):
    """Five steps of three stages."""

    def stage(z, x):
        return jnp.sin(z * x), None

    step = rematerialized(lambda z, _: (way(stage, z, jnp.array([0.3, 0.7, 1.1])), None))
    return lax.scan(step, z, None, length=5)[0]


@pytest.mark.long
def test_carries_are_found_without_running_the_stages():
    def plain(stage, z, each):
        return lax.scan(rematerialized(stage), z, each)[0]

    few, more = (jax.grad(partial(of_stages, way=way)) for way in (scan_stages, plain))
    loops = [jax.jit(f).lower(0.4).as_text().count("while(") for f in (few, more)]
    assert loops[0] < loops[1]
    assert float(few(0.4)) == pytest.approx(float(more(0.4)), rel=1e-14, abs=0)


@pytest.mark.long
def test_forward_mode_differentiates_loops_in_both_modes():
    """Through a `while_loop`, which reverse mode cannot pass, in both modes, of both orders, by one argument or two."""

    @forward_mode
    def power_and_sum(x, n):
        end = jax.lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * x), (0.0, jnp.ones_like(x)))
        return end[1], x + n

    def cube(x):
        return power_and_sum(x, jnp.asarray(3.0))[0]

    x = jnp.asarray(0.7)
    assert cube(x) == pytest.approx(0.343, rel=1e-15, abs=0)
    for way in (jax.grad, jax.jacfwd):
        assert way(cube)(x) == pytest.approx(3 * 0.49, rel=1e-15, abs=0)
        for outer in (jax.grad, jax.jacfwd):
            assert outer(way(cube))(x) == pytest.approx(6 * 0.7, rel=1e-15, abs=0)
    of_sum = jax.grad(lambda x, n: power_and_sum(x, n)[1] ** 2, (0, 1))(x, jnp.asarray(3.0))
    np.testing.assert_allclose(of_sum, [7.4, 7.4], rtol=1e-15)


@pytest.mark.long
def test_a_value_and_its_slopes_share_a_loop():
    @forward_mode
    def function(x, y):
        cube = jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * x), (0, jnp.ones_like(x)))[1]
        return cube * y * y

    at = jnp.asarray(0.7), jnp.asarray(1.3)
    assert str(jax.make_jaxpr(jax.value_and_grad(function, (0, 1)))(*at)).count(" while[") == 1
    for mixed in (jax.grad(jax.grad(function, 0), 1), jax.jacfwd(jax.jacfwd(function, 1), 0)):
        assert mixed(*at) == pytest.approx(6 * 0.49 * 1.3, rel=1e-15, abs=0)


def test_tangents_along_many_vectors_are_computed_once():
    """XLA replaces a division by a broadcast array, which is no barrier to fusion."""

    def vectors(mark):
        jacobian = jax.jacfwd(lambda x: mark(x * jnp.sin(x[0])))
        return jax.jit(jax.vmap(jacobian)).lower(jnp.ones((64, 3))).compile().as_text().count(" divide(")

    assert vectors(lambda x: jnp.stack(materialized(x))) > vectors(lambda x: x) == 0
