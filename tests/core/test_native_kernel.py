"""Loops as kernels of a GPU, here interpreted by Pallas: as JAX's vmap, and in runs as the other two engines."""

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
from internals import by_engine, engine_on, limit_kernels, refusal, runs_by
from jax import lax
from kernels import Kernel
from native_members import stacking
from small_steps import Oscillators, Paced

import lieint_jax as li
from lieint_jax import native
from lieint_jax.core import Step, StepInfo, pytree
from lieint_jax.runs import compiler_options

pytestmark = pytest.mark.long

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


def by_kernel(function, axes, *arguments):
    """`jax.vmap(function, axes)(*arguments)` as a kernel."""

    def by_one_step(*arguments):
        found = native.march(lambda n, carry, _: (carry, function(*arguments)), (), rows=1)[1]
        return jax.tree.map(lambda x: x[0], found)

    with native.computed_by("kernel", 1):
        return jax.jit(jax.vmap(by_one_step, axes))(*arguments)


def assert_as_vmap(function, axes, *arguments):
    found, expected = by_kernel(function, axes, *arguments), jax.jit(jax.vmap(function, axes))(*arguments)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, **ROUND_OFF)
    return found


@pytest.mark.parametrize("k", [2, 3])
def test_loops_and_branches_are_those_of_vmap(k):
    rng = np.random.default_rng(k)
    x, c = rng.normal(size=(40, 3)), rng.normal(size=17)
    found = assert_as_vmap(control, (0, None, None, None), x, np.linspace(0.1, 0.4, 300), k, c)
    assert len(np.unique(found[0]["turns"])) > 3  # members leave the loop at different times


def test_rows_that_a_step_writes_and_reads_are_those_of_vmap():
    rng = np.random.default_rng(0)
    x, weights, k = rng.normal(size=(40, 2)), rng.normal(size=(20, 2)) + 0.5, rng.integers(0, 20, 40)
    assert_as_vmap(stacking, (0, None, 0), x, weights, k)


@pytest.mark.quick
def test_a_kernel_rounds_as_jax():
    """Triton has no rounding: ties go to the even number, or away from 0, and just below a half is none."""
    x = np.array([-2.5, -1.5, -0.5, -0.2, 0.49999999999999994, 0.5, 1.5, 2.5, 1e17, np.inf, -np.inf, np.nan])
    both = lambda x: (jnp.round(x), lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO))  # noqa: E731
    for a, b in zip(by_kernel(both, 0, x), both(x), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.quick
@pytest.mark.parametrize("reverse", [False, True], ids=["forward", "reverse"])
def test_rows_of_all_kinds_are_those_of_a_scan(reverse):
    """Rows that members share and rows of their own, given and returned, of steps of which each third is stored."""
    rng = np.random.default_rng(4)
    x, shared, own = rng.normal(size=(70, 2)), rng.normal(size=(12, 2)), rng.normal(size=(70, 12))

    def run(x, own):
        def step(n, c, row):
            c = c + 0.1 * jnp.sin(c * row[0]) + row[1] / (1 + n)
            return c, (c[0], row[1] * n, c > 0, n)

        return native.march(step, x, (shared, own), rows=4, every=3, reverse=reverse)

    found = []
    for engine in ("kernel", "xla"):
        with native.computed_by(engine, 1):
            found.append(jax.jit(jax.vmap(run))(x, own))
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-15)


def test_gradients_by_a_kernel_are_those_of_the_other_engines():
    def loss(state, dt):
        end = li.integrate(li.schemes.so3_midpoint(BODY), state, dt, 20, save_every=10).state
        return jnp.sum(end.p[1:] ** 3)

    found = []
    for engine in ("kernel", "native", "xla"):
        with native.computed_by(engine, 1):
            gradient = jax.jit(jax.vmap(jax.grad(loss, (0, 1), allow_int=True), (0, None)))
            found.append(gradient(states_of(BODY), 0.05))
    for other in found[1:]:
        for a, b in zip(jax.tree.leaves(found[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, **ROUND_OFF)


def compared(step, state, dt):
    """One step of 20 members by vmap, by a kernel, and by machine code."""
    rng, n = np.random.default_rng(7), 20
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], n, 0), state)
    states = states._replace(p=states.p * (1 + 0.1 * rng.normal(size=states.p.shape)))

    def step_once(state, step, dt):
        after, info = step(state, dt)
        return after, info

    axes, arguments = (0, None, None), (states, step, np.asarray(dt))
    expected = jax.jit(jax.vmap(step_once, axes))(*arguments)
    of_cpu = Kernel(step_once, ("carry", "shared", "shared"), (state, step, arguments[2]))(arguments, n)
    of_cpu = of_cpu[0], jax.tree.map(lambda x: x[0], of_cpu[1])
    for found in (by_kernel(step_once, axes, *arguments), of_cpu):
        assert np.array_equal(found[1].converged, expected[1].converged)
        for a, b in zip(jax.tree.leaves(found[0]), jax.tree.leaves(expected[0]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * np.abs(np.asarray(b)).max())


HANDFUL = (
    *("rigid_body.asymmetric-exact", "heavy_top.lagrange-extrapolate[12]", "heavy_top.lagrange-gauss[4]"),
    *("group_potential.henon_heiles-group_alpha[exponential]", "rigid_bodies.binary-kepler_splitting[2]"),
    *("heavy_top.lagrange-top_energy_momentum[cayley]", "rigid_body.asymmetric-compose[suzuki](so3_midpoint[cayley])"),
    *("rigid_body.asymmetric-so3_explicit", "heavy_top.lagrange-splitting[so3_midpoint[symplectic]]"),
    "heavy_top.asymmetric_top-splitting[so3_midpoint[symplectic]]",
)


@pytest.mark.parametrize("name", HANDFUL)
def test_steps_are_those_of_vmap_and_of_machine_code(name):
    [(step, state, dt)] = [found for n, *found in grid.steps() if n == name]
    compared(step, state, dt)


def states_of(system, t=None):
    """Seven members."""
    w = np.random.default_rng(2).normal(size=(7, 3))
    states = jax.vmap(lambda w: system.state(angular_velocity=w))(w)
    return states if t is None else states._replace(t=jnp.asarray(t))


def assert_alike(kernel, native, plain):
    for found in (kernel, native):
        assert jax.tree.structure(found) == jax.tree.structure(plain)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, **ROUND_OFF)


def turning_potential(Gamma, t):
    return 0.5 * Gamma[0] ** 2 + 0.2 * jnp.cos(t) * Gamma[2]


DRIVEN = li.systems.driven_top(J, turning_potential, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t]))
GRADED = 0.7 + np.linspace(0, 1, 24) ** 1.5
OWN = Paced(li.schemes.splitting(DRIVEN), lambda state: 1 / (1 + state.p @ state.p))
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
        {"save_every": 7, "own_step": True},
    ),
    "an inner loop that members leave at different times": lambda: (
        (li.schemes.exact(BODY), states_of(BODY), 0.05, 10),
        {"save_every": 5},
    ),
}


@pytest.mark.parametrize("name", RUNS)
def test_runs_are_those_of_the_other_engines(monkeypatch, name):
    arguments, options = RUNS[name]()
    assert_alike(*runs_by(monkeypatch, ("kernel", "native", "xla"), *arguments, **options))


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


@pytest.mark.parametrize(
    "options",
    [{}, {"own_step": True}, {"save_at": np.array([0.1, 0.52, 0.71, 2.4])}],
    ids=["rows", "a step each", "outputs"],
)
def test_rows_failures_and_shorter_steps_are_those_of_the_other_engines(monkeypatch, options):
    """Members fail at steps of their own; a save after 11 steps comes in the middle of an iteration of four."""
    members, stiffness = 7, jnp.asarray(1.3)
    speed = np.linspace(0.1, 0.9, members)[:, None, None] * np.eye(3)[[1, 0, 2]]
    states = li.State(jnp.tile(jnp.eye(3), (members, 1, 1)), jnp.asarray(speed))
    step = Leaps(Oscillators(stiffness))
    if "own_step" in options:
        step = Leaps(Oscillators(jnp.linspace(1.0, 1.5, members)))
    rows = options if "save_at" in options else options | {"num_steps": 33, "save_every": 11}
    reduce = {} if "save_at" in options else {"reduce": "energy"}
    with pytest.warns(RuntimeWarning, match="did not converge"):
        runs = runs_by(
            monkeypatch, ("kernel", "native", "xla"), step, states, dt=0.1, **({"num_steps": 33} | rows | reduce)
        )
    assert_alike(*runs)
    if reduce:
        assert len(np.unique(runs[0].failed)) > 3
        assert (runs[0].failed < 0).any()


@pytest.mark.quick
def test_a_gpu_runs_kernels_of_short_steps_and_xla_others(monkeypatch):
    plans = []
    by_engine(monkeypatch, "xla", plans)
    states = li.State(jnp.tile(jnp.eye(3), (2, 1, 1)), jnp.zeros((2, 3, 3)))
    li.run(Leaps(Oscillators(jnp.asarray(1.3))), states, 0.05, 4, progress=False, save_every=None)
    [plan] = plans
    assert engine_on("gpu", plan) == "kernel"
    assert engine_on("cpu", plan) == "native"
    limit_kernels(monkeypatch, 5)
    assert "more than the 5 of a kernel" in refusal("kernel", plan)
    assert engine_on("gpu", plan) == "xla"


@pytest.mark.quick
@pytest.mark.parametrize(
    "options", [{}, {"xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL"}], ids=["cpu", "gpu"]
)
def test_xla_knows_the_options_of_the_loops(options):
    options = options or compiler_options("cpu")
    assert options in (compiler_options("cpu"), compiler_options("gpu"))
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
    for name in "native", "kernel", "xla":
        with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
            internals.by_engine(patch, name)
            if name != "native":
                internals.spread_over_devices(patch)
            more = {"store": f"{folder}/run.zarr"} if "store" in options else options
            more = more if "times" in options else {"dt": 0.1, "num_steps": 20} | more
            run = li.run(step, states, save_every=5, progress=False, **more)
            runs.append(jax.tree.map(lambda x: np.asarray(x[:]), (run.trajectory, run.summary)))
    for other in runs[1:]:
        for x, y in zip(jax.tree.leaves(runs[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(y, x, rtol=0, atol=4e-15)
print("equal", len(jax.devices()))
"""


def test_accelerators_share_the_members():
    """7 members on 3 devices, with padding; the floor is 1.8e-15, of an energy."""
    told = subprocess.run(
        [sys.executable, "-c", SPREAD], capture_output=True, text=True, cwd=Path(__file__).parents[1] / "lib"
    )
    assert told.stdout == "equal 3\n", told.stderr


def test_kernels_need_no_llvmlite():
    code = """
import sys
sys.modules["llvmlite"] = None
import jax.numpy as jnp, numpy as np
import lieint_jax as li
from lieint_jax.native import computed_by
run = lambda x: li.scan(lambda c, _: (jnp.cumsum(c), None), x, length=2)[0]
with computed_by("kernel", 1):
    print(run(np.ones(3)))
[loop] = li.explain(run, np.ones(3)).loops
print(loop.reason)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "[1. 3. 6.]" in told
    assert "llvmlite" in told
