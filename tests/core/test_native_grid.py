"""Every scheme with every system: steps as machine code for members that differ, against `jax.vmap` of the step."""

import jax
import numpy as np
import pytest

import lieint_jax as li

pytest.importorskip("llvmlite")

import grid
from native_members import MEMBERS, bits, compiled

pytestmark = pytest.mark.long

QUICK = {
    "rigid_body.free-so3_midpoint[exponential]",
    "driven_top.moving_axis-splitting[so3_midpoint[symplectic]]",
    "euler.kirchhoff-group_midpoint[cayley]",
}
NAN, FAILING = 5, 9


def members(state):
    """Copies of a state whose momenta differ by some percent."""
    scale = 1 + 0.05 * np.random.default_rng(3).normal(size=(MEMBERS, *np.shape(state.p)))
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], MEMBERS, 0), state)
    return states._replace(p=states.p * scale)


def stepped(state, step, dt):
    return step(state, dt)


def cases():
    marks = {name: [] if name in QUICK else [pytest.mark.long] for name, *_ in grid.steps()}
    return [pytest.param(*rest, id=name, marks=marks[name]) for name, *rest in grid.steps()]


@pytest.mark.parametrize(("step", "state", "dt"), cases())
def test_members_step_as_by_jax(step, state, dt):
    """Round-off apart, with the same verdicts; members that fail or are NaN change no bit of the others."""
    states, shared = members(state), (step, np.asarray(dt))
    by_jax = jax.jit(jax.vmap(stepped, (0, None, None)))
    native = compiled(stepped, [states], shared)
    expected, verdicts = by_jax(states, *shared)
    found, info = native([states])
    np.testing.assert_array_equal(info.converged, verdicts.converged)
    for wanted, x in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        wanted = np.asarray(wanted)
        assert (x.dtype, x.shape) == (wanted.dtype, wanted.shape)
        np.testing.assert_allclose(x, wanted, rtol=0, atol=2e-13 * max(1, np.abs(wanted).max(initial=0)))
    ill = states._replace(p=states.p.copy())
    ill.p[NAN], ill.p[FAILING] = np.nan, 1e6 * ill.p[FAILING]
    _, verdicts = by_jax(ill, *shared)
    beside, info = native([ill])
    well = np.delete(np.arange(MEMBERS), [NAN, FAILING])
    known = np.delete(np.arange(MEMBERS), FAILING)
    np.testing.assert_array_equal(info.converged[known], np.asarray(verdicts.converged)[known])
    assert bits(jax.tree.map(lambda x: x[well], beside)) == bits(jax.tree.map(lambda x: x[well], found))


def in_time():
    """Steps of systems that depend on time, whose members then share much of a step."""
    quick = ("driven_top.moving_axis-splitting[so3_midpoint[symplectic]]", "gravity_gradient.satellite-gauss[4]")
    return [
        pytest.param(*rest, id=name, marks=[] if name in quick else [pytest.mark.long])
        for name, *rest in grid.steps()
        if rest[1].t is not None
    ]


@pytest.mark.parametrize(("step", "state", "dt"), in_time())
def test_an_ensemble_that_shares_its_time_steps_as_by_jax(step, state, dt):
    states, count = members(state), 3
    expected, by_jax = states, jax.jit(jax.vmap(stepped, (0, None, None)))
    for _ in range(count):
        expected, _ = by_jax(expected, step, np.asarray(dt))
    run = li.run(step, states, float(dt), count, progress=False, save_every=None)
    for wanted, x in zip(jax.tree.leaves(expected), jax.tree.leaves(run.state), strict=True):
        wanted = np.asarray(wanted)
        np.testing.assert_allclose(x[-1], wanted, rtol=0, atol=1e-12 * max(1, np.abs(wanted).max(initial=0)))


@pytest.mark.compared
@pytest.mark.parametrize(("step", "state", "dt"), cases())
def test_no_machine_code_is_refused_for_its_rounding(step, state, dt, caplog):
    """The comparison of a first step with XLA's allows for what rounding may do, in every step that converges."""
    states = members(state)
    # of energies so close that `log_hamiltonian` with the energy of one of them accepts all
    states = states._replace(p=np.linspace(0.95, 1.05, MEMBERS).reshape(-1, *[1] * np.ndim(state.p)) * state.p)
    li.run(step, states, dt, 1, progress=False, save_every=None)
    assert not [record for record in caplog.records if "differs" in record.getMessage()]
