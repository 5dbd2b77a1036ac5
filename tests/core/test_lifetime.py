"""How long machine code lives: as long as something can call it, and no longer."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from internals import forget_loops, live_kernels

import lieint_jax as li

X = jnp.linspace(0.1, 0.9, 20)


def logistic(k):
    """A loop with machine code of its own."""
    return jax.jit(jax.vmap(lambda x: li.scan(lambda c, _: (3.2 * c * (1 - c) + 1e-3 * k, None), x, length=9)[0]))


def expected(k):
    with li.engine("xla"):
        return logistic(k)(X)


def counted():
    """The number of kernels after the loops that JAX and this package remember are forgotten."""
    forget_loops()
    jax.clear_caches()
    gc.collect()
    return live_kernels()


def near(found, k):
    np.testing.assert_allclose(found, expected(k), rtol=1e-6)  # float32; fused multiply-adds differ from XLA's


def test_code_lives_as_long_as_what_may_call_it():
    before = counted()
    lowered, compiled = logistic(1).lower(X), logistic(2).lower(X).compile()
    loaded = logistic(3).lower(X).compile().runtime_executable()  # without JAX's object around it
    first = np.array(logistic(4)(X))
    assert counted() == before + 3
    logistic(5)(X)  # would reuse the memory of code that is free
    near(lowered.compile()(X), 1)
    near(compiled(X), 2)
    near(loaded.execute([X])[0], 3)
    np.testing.assert_array_equal(logistic(4)(X), first)  # made again, of the same name
    del lowered, compiled, loaded
    assert counted() == before


@pytest.mark.long
def test_a_session_of_many_loops_holds_the_code_of_few():
    before = counted()
    kept = [logistic(k).lower(X).compile() for k in range(50)][7]
    assert counted() == before + 1
    near(kept(X), 7)
