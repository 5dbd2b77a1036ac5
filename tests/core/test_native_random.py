"""Random functions as machine code, against XLA: by themselves, and as potentials, laws and reduced quantities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("llvmlite")

from internals import runs_by
from random_checks import check
from random_functions import random_scalar

import lieint_jax as li

J = np.array([1.0, 2.0, 2.5])
ENGINES = ("native", "xla")


def test_random_functions_are_those_of_xla():
    found = check(range(3))
    assert found.unsupported == 0
    assert found.undecided < 0.05 * found.entries


@pytest.mark.long
@pytest.mark.parametrize("start", range(100, 2100, 20))
def test_many_random_functions_are_those_of_xla(start):
    found = check(range(start, start + 20))
    assert found.unsupported < 0.1 * found.functions
    assert found.undecided < 0.1 * found.entries


def assert_alike(native, plain):
    for a, b in zip(jax.tree.leaves(native), jax.tree.leaves(plain), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)  # a few steps of numbers near 1, well conditioned


def bounded(seed, *arrays):
    """A random function that is no larger than 1 and whose slopes are moderate."""
    return jnp.tanh(0.1 * random_scalar(seed, jnp.concatenate([x.ravel() for x in arrays])))


def states(system, **more):
    w = np.random.default_rng(2).normal(size=(7, 3))
    return jax.vmap(lambda w: system.state(angular_velocity=w, **more))(w)


SEEDS = pytest.mark.parametrize("seed", range(0, 30, 3))


@pytest.mark.long
@SEEDS
def test_random_potentials_and_reduced_quantities_run_as_by_xla(monkeypatch, seed):
    top = li.systems.potential_top(J, lambda axis: bounded(seed, axis))
    step = li.schemes.splitting(top)

    def reduce(step, state):
        return bounded(seed + 1, state.q, state.p) + step.system.energy(state)

    assert_alike(*runs_by(monkeypatch, ENGINES, step, states(top), 0.05, 6, save_every=3, reduce=reduce))


@pytest.mark.long
@SEEDS
def test_random_potentials_of_attitudes_run_as_by_xla(monkeypatch, seed):
    top = li.systems.potential_top(J, lambda attitude: bounded(seed, attitude), axis=None)
    assert_alike(*runs_by(monkeypatch, ENGINES, li.schemes.splitting(top), states(top), 0.05, 6, save_every=3))


@pytest.mark.long
@SEEDS
def test_random_laws_run_as_by_xla(monkeypatch, seed):
    def law(t, q, w):
        return 0.1 * bounded(seed, q, w, t) * jnp.array([1.0, -2.0, 0.5])

    body = li.systems.torqued_body(J, law)
    step = li.schemes.extrapolate(body, 4)
    assert_alike(*runs_by(monkeypatch, ENGINES, step, states(body, t=0.3, work=0.0), 0.05, 6, save_every=3))
