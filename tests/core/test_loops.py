"""Loops that end: a batched `while_loop` must get the same answer each time it asks whether a member goes on.

It asks in its condition, and again where it keeps or drops the turn of each member. Arithmetic on numbers of type float
may be compiled differently in the two places. A case of the attack looped for ever so, in float32.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import steps

from lieint_jax._numerics import elliptic, newton, small_linalg


def conditions(jaxpr):
    """The jaxprs of all conditions of while loops, however deep."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation.params["cond_jaxpr"].jaxpr
        composite = getattr(equation.params.get("_prim"), "params", {})  # what `custom_root` is in JAX ≥ 0.12
        for value in (*equation.params.values(), *composite.values()):
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from conditions(inner)


def computed(condition):
    """The operations of a condition whose result is a number of type float."""
    return [e.primitive.name for e in condition.eqns for x in e.outvars if jnp.issubdtype(x.aval.dtype, jnp.floating)]


def test_the_search_finds_arithmetic():
    loop = jax.make_jaxpr(jax.jit(lambda x: jax.lax.while_loop(lambda v: v * v > 2, lambda v: v / 2, x)))(4.0)
    assert [computed(c) for c in conditions(loop.jaxpr)] == [["mul"]]


def test_duplications_of_rj_go_on_by_a_flag():
    [condition] = conditions(jax.make_jaxpr(jax.vmap(elliptic.carlson_rj))(*jnp.ones((4, 2))).jaxpr)
    assert computed(condition) == []


def test_newton_s_method_goes_on_by_flags():
    def factored(x, *_):
        return small_linalg.Factored(lambda F: F / (2 * x), x > 0)

    def solve(x):
        F = lambda x: x * x - 2  # noqa: E731
        once = newton.chords(F, factored, jnp.abs, jnp.abs, jnp.ones_like(x), x, 9)
        return once, newton.repeated_chords(F, factored, jnp.abs, x, x, 1e-16 * x, 9)

    found = list(conditions(jax.make_jaxpr(solve)(1.5).jaxpr))
    assert [computed(c) for c in found] == [[], [], []]
    assert abs(jax.jit(solve)(1.5)[1][0] - np.sqrt(2)) < 5e-16


@pytest.mark.long
def test_no_step_computes_in_the_condition_of_a_loop():
    kinds = {(type(step), type(step.system)): (step, state, dt) for _, step, state, dt in steps()}
    found = [c for step, z, dt in kinds.values() for c in conditions(jax.make_jaxpr(step)(z, dt).jaxpr)]
    assert len(found) >= 20  # 24
    assert not any(map(computed, found))
