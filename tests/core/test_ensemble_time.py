"""Time, work and extra arrays in `li.run`, given times and output times; stores and resume keep all."""

import contextlib
import filecmp

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from internals import by_engine
from small_steps import Paced, Rests
from stores import Crash, disk_for

import lieint_jax as li
from lieint_jax import schemes, systems

pytestmark = pytest.mark.long

MEMBERS = 12
UNIFORM = {"dt": 0.05, "num_steps": 60, "save_every": 5}
GRADED = 0.7 + 3 * np.linspace(0, 1, 61) ** 1.5
OUTPUTS = np.sort(np.concatenate([[0.7, 3.7], GRADED[7:9], np.linspace(1, 2, 9), [1.1] * 6, [3.4, 3.41]]))
BETWEEN = {"times": GRADED, "save_at": OUTPUTS}
J = np.array([1.0, 2.0, 2.5])
BATCHED = []  # whether the axis was traced with a time for each member


@jax.custom_batching.custom_vmap
def turning(t):
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t])


@turning.def_vmap
def _(axis_size, in_batched, t):
    BATCHED.append(in_batched[0])
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t], axis=-1), in_batched[0]


def tilted(Gamma, t):
    return 0.5 * Gamma[0] ** 2 + 0.2 * jnp.cos(t) * Gamma[2]


TOP = systems.driven_top(J, tilted, turning)
SPLITTING, MIDPOINT = schemes.splitting(TOP), schemes.top_energy_momentum(TOP)
CONTROLLED = Paced(SPLITTING, lambda state: 1 / (1 + state.p @ state.p))
WHEEL = systems.driven_gyrostat(J, lambda t: jnp.stack([0.1 * jnp.sin(t), 0.05 + 0 * t, 0.1 * t]))


def started(t=0.7):
    """Twelve members, at one time or each at its own."""
    rng = np.random.default_rng(3)
    q = rng.normal(size=(MEMBERS, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return li.State(jnp.array(q), jnp.array(rng.normal(size=(MEMBERS, 3))), jnp.asarray(t), jnp.asarray(0.0))


def run(path=None, step=SPLITTING, states=None, uniform=UNIFORM, **options):
    states = started() if states is None else states
    return li.run(step, states, store=path, progress=False, **uniform, **options)


def alone(step, states, m, **uniform):
    """The same run of one member by `integrate`."""
    one = jax.tree.map(lambda x: x[m] if x.ndim else x, states)
    return jax.device_get(li.integrate(step, one, **(uniform or UNIFORM)))


def agree(found, m, expected):
    for a, b in zip(jax.tree.leaves(found.state), jax.tree.leaves(expected.state), strict=True):
        np.testing.assert_allclose(np.asarray(a)[:, m], b, rtol=0, atol=3e-15)  # observed 9e-16


@pytest.mark.parametrize("t", [0.7, np.full(MEMBERS, 0.7)], ids=["scalar", "equal values"])
def test_a_time_that_members_share_is_one_number_in_the_loop(t, monkeypatch):
    by_engine(monkeypatch, "xla")  # which maps over the members
    BATCHED.clear()
    jax.clear_caches()
    found = run(states=started(t))
    assert not any(BATCHED)
    times = 0.7 + 0.05 * (5 * np.arange(13))
    assert found.state.t.shape == (13, MEMBERS)
    np.testing.assert_allclose(found.state.t, np.tile(times[:, None], MEMBERS), rtol=4e-16)
    np.testing.assert_allclose(found.t, times, rtol=4e-16)
    agree(found, 7, alone(SPLITTING, started(), 7))


def test_members_may_start_at_times_of_their_own(monkeypatch):
    by_engine(monkeypatch, "xla")  # which maps over the members
    BATCHED.clear()
    jax.clear_caches()
    states = started(np.linspace(-1.0, 3.0, MEMBERS))
    found = run(states=states)
    assert any(BATCHED)
    for m in (0, 5):
        agree(found, m, alone(SPLITTING, states, m))
    np.testing.assert_array_equal(found.t, 0.05 * (5 * np.arange(13)))  # since the start of each


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("keys", [["times", "save_at"], ["times"], ["save_at"]], ids=" and ".join)
def test_steps_between_given_times_and_outputs_at_others(keys, small_chunks):
    """Seven outputs are at one time: more than a call of the loop may save."""
    options = {key: BETWEEN[key] for key in keys} | ({} if "times" in keys else {"dt": 0.05, "num_steps": 60})
    found = run(uniform=options if "save_at" in keys else options | {"save_every": None})
    expected = alone(SPLITTING, started(), 5, **options) if "save_at" in keys else None
    expected = expected or alone(SPLITTING, started(), 5, save_every=60, **options)
    assert found.info.converged.all()
    np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_array_equal(found.state.t, np.tile(expected.t[:, None], MEMBERS))
    agree(found, 5, expected)


def test_outputs_of_members_that_start_at_different_times_count_from_the_start():
    starts = 0.7 + 0.1 * np.arange(MEMBERS)
    found = run(states=started(starts), uniform={"dt": 0.05, "num_steps": 60, "save_at": OUTPUTS - 0.7})
    np.testing.assert_allclose(found.state.t, starts + found.t[:, None], rtol=1e-15)
    path = alone(SPLITTING, started(starts), 5, dt=0.05, num_steps=60, save_at=OUTPUTS - 0.7 + starts[5])
    agree(found, 5, path)


def test_extra_arrays_and_work_of_each_member():
    step = schemes.so3_midpoint(WHEEL)
    made = [
        WHEEL.state(angular_velocity=w, rotor=h, t=0.2, work=0.0)
        for w, h in np.random.default_rng(5).normal(size=(MEMBERS, 2, 3))
    ]
    states = jax.tree.map(lambda *x: jnp.stack(x), *made)
    found = run(step=step, states=states)
    assert found.state.extra["rotor"].shape == (13, MEMBERS, 3)
    for m in (0, 9):
        agree(found, m, alone(step, states, m))
    kept = jax.vmap(jax.vmap(lambda z: WHEEL.energy(z) - z.work))(jax.tree.map(jnp.asarray, found.state))
    assert np.abs(kept - kept[0]).max() < 2e-14  # observed 4e-15 of 2.6


def test_the_reduced_energy_is_energy_less_work():
    """Observed 2e-15; energy alone changes by 0.5."""
    found = run(step=MIDPOINT, reduce="energy").summary
    assert max(np.abs(found.least).max(), np.abs(found.greatest).max()) < 1e-14
    assert np.abs(found.state.work).max() > 0.1
    np.testing.assert_allclose(found.state.t, 3.7, rtol=4e-16)


@pytest.mark.quick
def test_a_reduced_quantity_is_that_of_the_states_at_their_own_times():
    """The time itself, of six steps that are saved in threes."""
    options = {"dt": 0.05, "num_steps": 6, "save_every": 3}
    found = run(step=Rests(TOP), reduce=lambda step, state: state.t, uniform=options).summary
    np.testing.assert_allclose(found.least[1:], [0.05, 0.2], rtol=1e-14)
    np.testing.assert_allclose(found.greatest[1:], [0.15, 0.3], rtol=1e-14)


def controlled():
    """A run in which each member advances its own time."""
    states = started()._replace(t=jnp.full(MEMBERS, 0.7), work=jnp.zeros(MEMBERS))
    return {"step": CONTROLLED, "states": jax.vmap(CONTROLLED.start)(states)}


RUNS = [dict, lambda: {"reduce": "energy"}, lambda: {"uniform": BETWEEN}, controlled]


@pytest.mark.parametrize("make", RUNS, ids=["trajectory", "summary", "given times and outputs", "own time"])
def test_a_run_that_ended_resumes_to_the_same_bits(tmp_path, small_chunks, make):
    path, whole, options, ends = tmp_path / "run.zarr", tmp_path / "whole.zarr", make(), 0
    run(whole, **options)
    for most in (30, 40, 45, 1000):
        with contextlib.suppress(Crash), disk_for(most) as waits:
            run(path, resume=True, **options)
        ends += len(waits) > most
    assert ends >= 2
    names = sorted(str(f.relative_to(whole)) for f in whole.rglob("*") if f.is_file())
    assert sum(name.startswith("work/c/") for name in names) > 1 or "reduce" in options
    assert filecmp.cmpfiles(path, whole, names, shallow=False)[1:] == ([], [])


def test_a_run_at_another_time_does_not_resume(tmp_path):
    path = tmp_path / "run.zarr"
    run(path)
    with pytest.raises(ValueError, match="the initial states differ"):
        run(path, states=started(0.8), resume=True)


def test_states_without_what_they_need_are_refused():
    states = started()
    cases = {
        "the system is driven, so its state needs the time": states._replace(t=None, work=None),
        r"t and work may be scalars; got .*t \(2,\)": states._replace(t=jnp.zeros(2)),
        r"states\.t must be finite, got nan": states._replace(t=jnp.asarray(np.nan)),
        r"states\.work must be finite, and is not finite for .*: 3": states._replace(
            work=jnp.zeros(MEMBERS).at[3].set(np.inf)
        ),
        r"must be an identifier, such as .rotor., got 'my wheel'": states._replace(
            extra={"my wheel": jnp.zeros((12, 3))}
        ),
    }
    for message, bad in cases.items():
        with pytest.raises(ValueError, match=message):
            run(states=bad)
    with pytest.warns(RuntimeWarning, match="count time from a nearer epoch"):
        run(states=states._replace(t=jnp.asarray(1e9)))


@pytest.mark.parametrize("where", ["memory", "store"])
def test_members_of_a_reduced_run_end_at_the_times_of_the_saved_one(tmp_path, where):
    """To the bit, where states count work too, so that the sizes of steps are rounded."""
    states, path = started(np.linspace(0.1, 3.3, MEMBERS)), tmp_path / "run.zarr" if where == "store" else None
    size = {"dt": 0.07, "num_steps": 61, "save_every": 61}
    saved, reduced = run(states=states, uniform=size), run(path, states=states, uniform=size, reduce="energy")
    np.testing.assert_array_equal(reduced.summary.state.t, saved.state.t[-1])
