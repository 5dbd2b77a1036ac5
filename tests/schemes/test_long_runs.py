"""Every scheme with every system, in ensembles: what it declares conserved stays so over a long run, and its order.

One compiled step serves both. The reference is `diagnostics.flow`: collocation of order 16 for the vector field itself.
"""

import functools

import jax
import numpy as np
import pytest

pytest.importorskip("llvmlite")

import grid
from native_members import compiled

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.native import UnsupportedError

MEMBERS, LONG, SHORT = 8, 2000, 20
FLOOR = 1e-11  # the least error that shows an order: the reference is right to some 1e-14
GRID = [pytest.param(*case, id=case[1]) for case in grid.cases()]
FINER = {"pseudo_rigid_body": 8, "incompressible_body": 4}  # parts of an example's dt that resolve its fast vibrations


def members(step, state):
    """Copies of a state whose momenta differ by some percent."""
    scale = 1 + 0.02 * np.random.default_rng(3).normal(size=(MEMBERS,) + np.ndim(state.p) * (1,))
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], MEMBERS, 0), state)
    states = states._replace(p=states.p * scale)
    return jax.device_get(jax.vmap(step.start)(states)) if step.own_time else states


@functools.cache
def energies_and_momenta():
    """(system, states (time, member, …)) ↦ H − W and the momenta."""

    def of_state(system, state):
        return system.energy(state) - (0.0 if state.work is None else state.work), system.momentum(state)

    return jax.jit(jax.vmap(jax.vmap(of_state, (None, 0)), (None, 0)))


def flow(state, t, system):
    return diagnostics.flow(system, state, t, 2 * SHORT)


@functools.cache
def reference(name, with_time):
    """(system, states, times (members,)) ↦ the exact states after those times."""
    system, state, _ = dict(grid.systems())[name]
    state = jax.tree.map(lambda x: np.asarray(x)[None], state._replace(t=1.0 if with_time else None))
    try:
        return compiled(flow, [state, np.zeros(1)], [system])
    except UnsupportedError:  # a system whose vector field solves linear equations by LAPACK
        by_xla = jax.jit(jax.vmap(flow, (0, 0, None)))
        return lambda member, shared: by_xla(*member, *shared)


def order_and_error(name, step, states, dt):
    """The order by two runs of the same length, and the error of the longer steps."""
    errors = []
    for parts in (1, 2):
        run = li.run(step, states, dt / parts, SHORT * parts, progress=False, save_every=None)
        end = jax.tree.map(lambda x: x[-1], run.state)
        times = np.asarray(end.t - states.t) if step.own_time else np.full(MEMBERS, SHORT * dt)
        exact = reference(name, states.t is not None)([states, times], [step.system])
        size = np.abs(exact.p).max(initial=1e-300)
        errors.append(max(np.abs(end.q - exact.q).max(), np.abs(end.p - exact.p).max(initial=0) / size))
    return np.log2(errors[0] / errors[1]), errors


@pytest.mark.long
@pytest.mark.parametrize(("scheme", "name", "step", "state", "dt"), GRID)
def test_long_runs_conserve_what_their_scheme_declares_at_its_order(scheme, name, step, state, dt):
    system_name = name.partition("-")[0]
    states = members(step, state)
    run = li.run(step, states, float(dt), LONG, save_every=LONG // 20, progress=False)
    energies, momenta = (np.asarray(x) for x in energies_and_momenta()(step.system, run.state))
    if grid.declares(scheme, name, "energy"):
        assert np.abs(energies / energies[0] - 1).max() < 2e-12  # 5e-13, of a binary; 1e-14 of most
    if grid.declares(scheme, name, "momentum"):
        assert np.abs(momenta - momenta[0]).max(initial=0) <= 3e-13 * np.abs(momenta).max(initial=0)  # 8e-14
    if state.extra is None:  # the vector field has no inner states
        dt = float(dt) / FINER.get(system_name.partition(".")[0], 1)
        order, errors = order_and_error(system_name, step, states, dt)
        if errors[1] > FLOOR:
            assert order == pytest.approx(step.order, abs=0.15)
        else:
            assert errors[0] < FLOOR * 2.0 ** (step.order + 1)
