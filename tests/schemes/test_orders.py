"""The order of every scheme, in one table: two runs, of n and of 2n steps, next to DOP853 of scipy.

A row of `tests/data/orders.txt` is a step of the system s, an example of the grid; the time T; n; and the order. The
error is the largest of q, of p relative to its largest, and of the work. `test_long_runs.py` measures the order of
every pair of the grid; these are the families, compositions and rules that the grid lacks, and each scheme once. Rows
after the blank line run in shards. A scheme without a row is measured by its first step in the grid.
"""

import functools

import data_files
import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from repeated import last
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import maps
from lieint_jax.core import time_derivative

OTHERS = {"exact", "calibrated", "langevin"}  # the first two are the flow; test_langevin.py has the order of the third
QUICK, LONG = (
    [[x.strip() for x in row.split("|")] for row in part.splitlines()]
    for part in data_files.text("orders.txt").strip().split("\n\n")
)
ROWS = {step.partition("(")[0] for step, *_ in QUICK + LONG}
MISSING = {entry.name for entry in li.schemes.catalogue()} - ROWS - OTHERS
NAMES = vars(li.schemes) | {"cayley": maps.kappa_cayley, "calm": lambda state: 1 / jnp.sqrt(1 + jnp.sum(state.p**2))}


def example(name):
    module, _, name = name.partition(".")
    return grid.examples_of(module)[name]


@functools.cache
def exact(name, T):
    """The state of an example after T."""
    system, state, _ = example(name)
    y, unravel = ravel_pytree(state)
    rate = jax.jit(lambda y: ravel_pytree(time_derivative(system, unravel(y)))[0])
    path = solve_ivp(lambda t, y: np.asarray(rate(y)), (0, T), y, "DOP853", rtol=3e-14, atol=1e-15)
    return jax.device_get(unravel(path.y[:, -1]))


def without_row():
    """For schemes without a row the first step in the grid, its example, T, n and order: 40 steps of Δt, 20 of 2Δt."""
    found = reversed(grid.cases() if MISSING else [])
    rows = {x: (step, name.partition("-")[0], 40 * dt, 20, step.order) for x, name, step, _, dt in found}
    return {scheme: rows[scheme] for scheme in MISSING & set(rows)}


def cases():
    for scheme, row in without_row().items():
        yield pytest.param(*row, id=scheme)
    for row in QUICK + LONG:
        yield pytest.param(*row, id=f"{row[0]} {row[1]}", marks=[pytest.mark.long] * (row in LONG))


@pytest.mark.parametrize(("step", "name", "T", "n", "order"), list(cases()))
def test_a_step_has_its_order(step, name, T, n, order):
    system, state, _ = example(name)
    step = eval(step, NAMES, {"s": system}) if isinstance(step, str) else step
    T, order, errors = float(T), int(order), []
    start = step.start(state)
    for count in (int(n), 2 * int(n)):
        path = li.integrate(step, start, T / count, count, save_every=count)
        assert path.info.converged.all()
        end = jax.device_get(last(path))
        true = exact(name, float(end.t - start.t) if step.own_time else T)
        pairs = (end.q, true.q, 1.0), (end.p, true.p, np.abs(true.p).max(initial=1e-300)), (end.work, true.work, 1.0)
        errors.append(max(np.abs(a - b).max(initial=0) / size for a, b, size in pairs if a is not None))
    assert step.order == order
    assert errors[1] > 1e-12  # above the floor of 1e-13
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15 if order < 8 else 0.5)


def test_every_scheme_is_measured():
    assert ROWS | OTHERS | set(without_row()) == {entry.name for entry in li.schemes.catalogue()}
    assert not ROWS & OTHERS
    assert len(ROWS) >= 20
