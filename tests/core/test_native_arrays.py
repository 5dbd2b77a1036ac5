"""Programs of numbers on arrays of the members: as JAX's vmap, and in runs as the other two engines."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from internals import by_engine, engine_on, limit_flat_engine, refusal, runs_by
from jax import lax
from kernels import Kernel
from native_members import stacking
from small_steps import Oscillators

import lieint_jax as li
from lieint_jax import ensemble
from lieint_jax.native import Flattened
from lieint_jax.types import Step, StepInfo, pytree

J = np.array([1.0, 2.0, 2.5])
BODY = li.systems.rigid_body(J)
TOP = li.systems.heavy_top(J, [0.0, 0.0, 1.0])
ROUND_OFF = {"rtol": 1e-11, "atol": 1e-12}


def control(x, table, k, c):
    """Loops and branches by what is shared and by what is the member's, tables, and entries of arrays by an index."""
    y = lax.fori_loop(0, k, lambda n, y: y + table[n] * jnp.sin(y + n), x)
    y = lax.scan(lambda y, a: (a[0] * y + a[1], None), y, jnp.outer(c, jnp.arange(1.0, 3.0)))[0]
    z, turns = lax.while_loop(lambda s: (s[0] > 0.3) & (s[1] < 9), lambda s: (0.7 * s[0], s[1] + 1), (jnp.abs(x[0]), 0))
    w = lax.cond(k > 2, lambda v: v * 2, lambda v: v / 3, y)
    w = lax.cond(z > 0.25, lambda v: v + z, lambda v: v - z, w)
    each = jax.vmap(lambda v: lax.while_loop(lambda u: u > 0.1, lambda u: u / 2, v))(jnp.abs(w))
    chosen = w[jnp.argmax(w)] + x[jnp.clip(turns, 0, 2)] + table[turns]
    return {"z": z, "each": each, "turns": turns, "chosen": chosen}, jnp.round(w) + jnp.sign(y), y > w, jnp.array(2.5)


@pytest.mark.long
@pytest.mark.parametrize("k", [2, 3])
def test_loops_and_branches_are_those_of_vmap(k):
    rng = np.random.default_rng(k)
    x, c = rng.normal(size=(40, 3)), rng.normal(size=17)
    table = np.linspace(0.1, 0.4, 300)
    flat = Flattened(control, ("member", "shared", "shared", "shared"), (x[0], table, np.asarray(k), c))
    found, expected = (jax.jit(f)(x, table, k, c) for f in (flat, jax.vmap(control, (0, None, None, None))))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, **ROUND_OFF)
    assert len(np.unique(found[0]["turns"])) > 3  # members leave the loop at different times


@pytest.mark.long
def test_rows_that_a_step_writes_and_reads_are_those_of_vmap():
    rng = np.random.default_rng(0)
    x, weights, k = rng.normal(size=(40, 2)), rng.normal(size=(20, 2)) + 0.5, rng.integers(0, 20, 40)
    flat = Flattened(stacking, ("member", "shared", "member"), (x[0], weights, k[0]))
    found, expected = (jax.jit(f)(x, weights, k) for f in (flat, jax.vmap(stacking, (0, None, 0))))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, **ROUND_OFF)


def test_the_width_counts_simultaneous_values_and_those_carried_by_loops():
    kinds, examples = ("member", "shared"), (np.zeros(8), np.asarray(3))

    def chain(x, n):
        return jnp.prod(x)

    def wide(x, n):
        return jnp.prod(x) * jnp.sin(x)

    def loop(x, n):
        return lax.fori_loop(0, n, lambda k, c: (c[0] + c[1], c[1] * c[0], c[2]), (x[0], x[1], 2.0))[0]

    chain, wide, loop = (Flattened(f, kinds, examples) for f in (chain, wide, loop))
    assert chain.width == 2 * 3  # two factors and their product, in float64
    assert 2 * 8 <= wide.width <= 2 * 18  # eight results at the end
    assert chain.carried == wide.carried == 0
    assert loop.carried == 2  # 2.0 is a constant, and the counter is shared


def compared(step, state, dt):
    """One step of 20 members by vmap, by arrays, and by machine code."""
    rng, n = np.random.default_rng(7), 20
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], n, 0), state)
    states = states._replace(p=states.p * (1 + 0.1 * rng.normal(size=states.p.shape)))

    def step_once(state, step, dt):
        after, info = step(state, dt)
        return after, info

    kinds, arguments = ("carry", "shared", "shared"), (states, step, np.asarray(dt))
    flat = jax.jit(Flattened(step_once, kinds, (state, step, arguments[2])))(*arguments)
    expected = jax.jit(jax.vmap(step_once, (0, None, None)))(*arguments)
    native = Kernel(step_once, kinds, (state, step, arguments[2]))(arguments, n)
    native = native[0], jax.tree.map(lambda x: x[0], native[1])
    for found in (flat, native):
        assert np.array_equal(found[1].converged, expected[1].converged)
        for a, b in zip(jax.tree.leaves(found[0]), jax.tree.leaves(expected[0]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * np.abs(np.asarray(b)).max())


HANDFUL = (
    *("rigid_body.asymmetric-exact", "heavy_top.lagrange-extrapolate[12]", "heavy_top.lagrange-gauss[4]"),
    *("group_potential.henon_heiles-group_alpha[exponential]", "rigid_bodies.binary-kepler_splitting[2]"),
    *("heavy_top.lagrange-top_energy_momentum[cayley]", "rigid_body.asymmetric-compose[suzuki](so3_midpoint[cayley])"),
    *("rigid_body.asymmetric-so3_explicit", "heavy_top.lagrange-splitting[so3_midpoint[symplectic]]"),
)


@pytest.mark.long
def test_a_step_is_that_of_vmap_and_of_machine_code():
    compared(li.schemes.splitting(TOP), TOP.state(angular_velocity=[0.3, 0.2, 1.0]), 0.05)


@pytest.mark.long
@pytest.mark.parametrize("name", HANDFUL)
def test_steps_are_those_of_vmap_and_of_machine_code(name):
    [(step, state, dt)] = [found for n, *found in grid.steps() if n == name]
    compared(step, state, dt)


def states_of(system, t=None):
    """Seven members."""
    w = np.random.default_rng(2).normal(size=(7, 3))
    states = jax.vmap(lambda w: system.state(angular_velocity=w))(w)
    return states if t is None else states._replace(t=jnp.asarray(t))


def assert_alike(flat, native, plain):
    for found in (flat, native):
        assert jax.tree.structure(found) == jax.tree.structure(plain)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, **ROUND_OFF)


def turning_potential(Gamma, t):
    return 0.5 * Gamma[0] ** 2 + 0.2 * jnp.cos(t) * Gamma[2]


DRIVEN = li.systems.driven_top(J, turning_potential, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t]))
GRADED = 0.7 + np.linspace(0, 1, 24) ** 1.5
OWN = li.schemes.reversible_control(li.schemes.splitting(DRIVEN), lambda state: 1 / (1 + state.p @ state.p))
RUNS = {
    "prepared steps, a shorter step to outputs": lambda: (
        (li.schemes.so3_explicit(BODY), states_of(BODY), 0.05, 30),
        {"save_at": np.array([0.1, 0.33, 0.34, 1.2])},
    ),
    "the energy, and the last state": lambda: (
        (li.schemes.splitting(TOP), states_of(TOP), 0.05, 22),
        {"save_every": 11, "reduce": "energy"},
    ),
    "a time that members share": lambda: (
        (li.schemes.splitting(DRIVEN), states_of(DRIVEN, 0.7), 0.05, 22),
        {"save_every": 11},
    ),
    "times of their own": lambda: (
        (li.schemes.splitting(DRIVEN), states_of(DRIVEN, np.linspace(0, 1, 7)), 0.05, 22),
        {"save_every": 11, "reduce": "energy"},
    ),
    "given times": lambda: (
        (li.schemes.splitting(DRIVEN), states_of(DRIVEN, 0.7)),
        {"times": GRADED, "save_at": np.array([0.8, 0.91, 1.5])},
    ),
    "many given times": lambda: (
        (li.schemes.so3_midpoint(BODY), states_of(BODY)),
        {"times": np.linspace(0, 1, 400) ** 1.5, "save_every": 57},
    ),
    "steps with a time of their own": lambda: (
        (OWN, jax.vmap(OWN.start)(states_of(DRIVEN, np.full(7, 0.7))), 0.05, 22),
        {"save_every": 11},
    ),
    "a step each, prepared": lambda: (
        (
            jax.vmap(lambda J: li.schemes.so3_explicit(li.systems.rigid_body(J)))(J + 0.1 * np.arange(7)[:, None] / 7),
            states_of(BODY),
            0.05,
            21,
        ),
        {"save_every": 7, "step_axis": 0},
    ),
    "an inner loop that members leave at different times": lambda: (
        (li.schemes.exact(BODY), states_of(BODY), 0.05, 10),
        {"save_every": 5},
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_runs_are_those_of_the_other_engines(monkeypatch, name):
    arguments, options = RUNS[name]()
    assert_alike(*runs_by(monkeypatch, ("flat", "native", "xla"), *arguments, **options))


@pytree
class Leaps(Step):
    """A leap of the oscillators, with a constant of whole steps; it does not converge where it comes too far."""

    system: Any
    kick: Any = None

    order, symmetric, name = 1, False, "leaps"

    def with_constants(self, state, dt):
        return replace(self, kick=dt * self.system.stiffness)

    def advance(self, state, dt):
        p = state.p - (dt * self.system.stiffness if self.kick is None else self.kick) * state.q
        q = state.q + dt * p
        return state._replace(q=q, p=p), StepInfo(jnp.abs(p).max(), q[0, 1] < 0.5)


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [{}, pytest.param({"step_axis": 0}, marks=pytest.mark.long), {"save_at": np.array([0.1, 0.52, 0.71, 2.4])}],
    ids=["rows", "a step each", "outputs"],
)
def test_rows_failures_and_shorter_steps_are_those_of_the_other_engines(monkeypatch, options):
    """Members fail at steps of their own; a save after 11 steps comes in the middle of an iteration of four."""
    members, stiffness = 7, jnp.asarray(1.3)
    speed = np.linspace(0.1, 0.9, members)[:, None, None] * np.eye(3)[[1, 0, 2]]
    states = li.State(jnp.tile(jnp.eye(3), (members, 1, 1)), jnp.asarray(speed))
    step = Leaps(Oscillators(stiffness))
    if "step_axis" in options:
        step = Leaps(Oscillators(jnp.linspace(1.0, 1.5, members)))
    rows = options if "save_at" in options else options | {"num_steps": 33, "save_every": 11}
    reduce = {} if "save_at" in options else {"reduce": "energy"}
    with pytest.warns(RuntimeWarning, match="did not converge"):
        runs = runs_by(
            monkeypatch, ("flat", "native", "xla"), step, states, dt=0.1, **({"num_steps": 33} | rows | reduce)
        )
    assert_alike(*runs)
    if reduce:
        assert len(np.unique(runs[0].failed)) > 3
        assert (runs[0].failed < 0).any()


@pytest.mark.long
def test_an_accelerator_uses_arrays_for_short_steps_and_the_plain_loop_for_others(monkeypatch):
    jobs = []
    by_engine(monkeypatch, "xla", jobs)
    states = li.State(jnp.tile(jnp.eye(3), (2, 1, 1)), jnp.zeros((2, 3, 3)))
    ensemble.run(Leaps(Oscillators(jnp.asarray(1.3))), states, 0.05, 4, progress=False)
    [job] = jobs
    assert engine_on("gpu", job) == "flat"
    assert engine_on("cpu", job) == "native"
    for what in ("registers", "carried"):
        with monkeypatch.context() as patch:
            limit_flat_engine(patch, what, 5)
            assert "more than 5" in refusal("flat", job)
            assert engine_on("gpu", job) == "xla"


@pytest.mark.parametrize(
    "options", [{}, {"xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL"}], ids=["cpu", "gpu"]
)
def test_xla_knows_the_options_of_the_loops(options):
    options = options or ensemble.compiler_options("cpu")
    assert options in (ensemble.compiler_options("cpu"), ensemble.compiler_options("gpu"))
    assert jax.jit(lambda x: x + 1).lower(1.0).compile(compiler_options=options)(1.0) == 2.0
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.jit(lambda x: x + 1).lower(1.0).compile(compiler_options={"xla_gpu_enable_command_buffers": "WHILE"})


SPREAD = """
import jax, numpy as np, pytest, tempfile
import internals
import lieint_jax as li

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 3)
body = li.systems.rigid_body([1.0, 2.0, 3.0])
step = li.schemes.so3_explicit(body)
states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.random.default_rng(0).normal(size=(7, 3)))
for options in {}, {"reduce": "energy"}, {"store": True}, {"times": np.linspace(0, 1, 21) ** 2}:
    runs = []
    for name in "native", "flat", "xla":
        with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
            internals.by_engine(patch, name)
            if name != "native":
                internals.spread_over_devices(patch)
            more = {"store": f"{folder}/run.zarr"} if "store" in options else options
            more = more if "times" in options else {"dt": 0.1, "num_steps": 20} | more
            run = li.ensemble.run(step, states, save_every=5, progress=False, **more)
            runs.append(jax.tree.map(lambda x: np.asarray(x[:]), run))
    for other in runs[1:]:
        for x, y in zip(jax.tree.leaves(runs[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(y, x, rtol=0, atol=4e-15)
print("equal", len(jax.devices()))
"""


@pytest.mark.long
def test_accelerators_share_the_members():
    """7 members on 3 devices, with padding; the floor is 1.8e-15, of an energy."""
    told = subprocess.run(
        [sys.executable, "-c", SPREAD], capture_output=True, text=True, cwd=Path(__file__).parents[1] / "lib"
    )
    assert told.stdout == "equal 3\n", told.stderr


@pytest.mark.long
def test_arrays_need_no_llvmlite():
    code = """
import sys
sys.modules["llvmlite"] = None
import jax, jax.numpy as jnp, numpy as np
import lieint_jax as li
from lieint_jax.native import flatten
flat = flatten(jnp.cumsum, ("member",), (np.zeros(3),))
assert np.array_equal(jax.jit(flat)(np.ones((2, 3))), [[1, 2, 3]] * 2)
[loop] = li.explain(lambda x: li.scan(lambda c, _: (jnp.cumsum(c), None), x, length=2), np.ones(3)).loops
print(loop.reason)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "llvmlite" in told
