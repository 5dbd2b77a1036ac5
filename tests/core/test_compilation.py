"""A step made again compiles nothing, and the command line keeps compiled programs, in a folder of this processor."""

import functools
import gc
import logging
import os
import re
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import lieint_jax as li
from lieint_jax._cache import use_program_cache
from lieint_jax._xla import _compile, _reads
from lieint_jax.native import _machine, _traced
from lieint_jax.runs import _loop

NAMES = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


def programs(caplog, function):
    """The names of the programs that jax compiles, or loads, for a call."""
    caplog.clear()
    with jax.log_compiles():
        jax.block_until_ready(function())
    texts = [record.getMessage() for record in caplog.records]
    return [re.split(r"[ )]", text.removeprefix("Compiling jit("))[0] for text in texts if text.startswith("Compiling")]


def a_step(dt=0.05):
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    return li.schemes.so3_midpoint(body), body.state(angular_velocity=[0.2, dt, 1.0]), dt


def last_of_q(state):
    return state.q[3]


@pytest.mark.long
@pytest.mark.parametrize(
    "call",
    [
        lambda s, z, dt: li.integrate(s, z, dt, 6, save_every=3),
        lambda s, z, dt: li.integrate(s, z, dt, save_at=[0.7, 0.3], adjoint=li.ReversibleAdjoint()),
        lambda s, z, dt: jax.grad(
            lambda h: li.integrate(s, z, h, save_at=[0.3, 0.7], adjoint=li.ReversibleAdjoint()).state.q[-1, 0]
        )(dt),
        lambda s, z, dt: li.integrate(s, z, dt, save_at=[14.2 * dt, 6 * dt]),
        lambda s, z, dt: li.integrate(s, z, dt, 6, save_every=3, adjoint=li.ReversibleAdjoint()),
        lambda s, z, dt: li.diagnostics.round_trip_error(s, z, dt, 6),
        lambda s, z, dt: li.diagnostics.poisson_error(s, z, dt, 6),
        lambda s, z, dt: li.diagnostics.order(s, z, dt),
        lambda s, z, dt: s.system.solution(z, dt),
        lambda s, z, dt: li.integrate(s, z, dt, round(5 / dt), save_at=np.linspace(0.1, 4.0, round(1 / dt))),
        lambda s, z, dt: li.event(s, z, dt, last_of_q, round(5 / dt)),
        lambda s, z, dt: li.run(s, z, dt, round(5 / dt), progress=False).at(np.linspace(0.1, 4.0, round(1 / dt))),
    ],
)
def test_a_step_made_again_with_other_numbers_compiles_nothing(caplog, call):
    if not programs(caplog, lambda: call(*a_step())):  # another test of this process had it compiled
        jax.clear_caches()
        assert programs(caplog, lambda: call(*a_step()))
    assert not programs(caplog, lambda: call(*a_step(0.04)))


def assert_a_second_call_compiles_nothing(caplog, step, state, dt):
    end, _ = step(state, dt)
    assert not programs(caplog, lambda: step(end, dt))


def test_a_step_that_iterates_compiles_nothing_at_a_second_call_outside_of_jit(caplog):
    """A loop is a program of its own there, of functions that are made in the call."""
    body = li.systems.torqued_body([1.0, 2.0, 2.5], li.torques.viscous([0.1, 0.1, 0.1]))
    step = li.schemes.torqued_midpoint(body)
    assert step.loops
    assert_a_second_call_compiles_nothing(caplog, step, body.state(angular_velocity=[0.2, 0.1, 1.0]), 0.1)


FIRST = """
import jax
jax.config.update("jax_enable_x64", True)
import lieint_jax as li

compiled = []
event = "/jax/core/compile/backend_compile_duration"
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **of: name == event and compiled.append(of))

li.jit(lambda x: x)(0.0)  # learns once which options XLA has, by a call that it may refuse
compiled.clear()

def show(name, value):
    print(name, len(compiled))
    compiled.clear()
    return value

show("import", None)
body = show("body", li.systems.rigid_body([1.0, 2.0, 3.0]))
step = show("step", li.schemes.so3_midpoint(body))
state = show("state", body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0]))
show("another state", body.state([0.8, 0.6, 0, 0], angular_velocity=(0, 0.1, 1)))
show("run", li.integrate(step, state, 0.05, 1000))
show("longer run", li.integrate(step, state, 0.04, 2000))
show("save_every", li.integrate(step, state, 0.04, 2000, save_every=10))
show("longer, save_every", li.integrate(step, state, 0.04, 3000, save_every=10))
show("another save_every", li.integrate(step, state, 0.04, 3000, save_every=30))
show("certificate", li.diagnostics.certify(step, state, 0.05, 1000))
"""
MOST = {  # programs: a run also tries its first step; any save_every > 1 has one; a certificate has four measurements
    "import": 0,
    "body": 0,
    "step": 0,
    "state": 1,
    "another state": 0,
    "run": 1,
    "longer run": 0,
    "save_every": 1,
    "longer, save_every": 0,
    "another save_every": 0,
    "certificate": 4,
}


def test_first_calls_compile_few_programs():
    shown = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True).stdout
    counts = {name: int(count) for name, count in (line.rsplit(" ", 1) for line in shown.splitlines())}
    assert counts.keys() == MOST.keys()
    assert {name: count for name, count in counts.items() if count > MOST[name]} == {}


def run_and_scale(p, factor=1.0, count=4):
    step, state, dt = a_step()
    return factor * jnp.sum(li.integrate(step, state._replace(p=p), dt, count, save_every=count).state.q ** 3)


@pytest.mark.long
@pytest.mark.compared
@pytest.mark.parametrize("members", [1, 3])
def test_a_run_compiles_its_machine_code_once(monkeypatch, caplog, members):
    """The check against XLA of a run of one body was of code for vectors of members, which nothing else used.

    Numbers of the step that JAX promotes to the type of others (here the inertia) were traced again for this check.
    """
    made, kernel = [], _machine.kernel
    monkeypatch.setattr(_machine, "kernel", lambda *given: made.append(given) or kernel(*given))
    log, interval = logging.getLogger("traced"), _loop.MemberLoop._interval

    def noted(*given):
        log.warning("an interval")  # a list would be read, and changes
        return interval(*given)

    monkeypatch.setattr(_loop.MemberLoop, "_interval", noted)
    top = li.systems.potential_top(jnp.full(3, 2.0), lambda g: 0.3 * g[2] ** 2)
    states = jax.vmap(lambda w: top.state(angular_velocity=w))(jnp.eye(3)[:members])
    run = li.run(li.schemes.splitting(top), states, 0.05, 20, progress=False)
    assert run.converged.all()
    assert len(made) == [record.name for record in caplog.records].count("traced") == 1


def test_li_jit_gives_the_values_of_jax_jit_and_serves_inside_transformations():
    p, ours, theirs = a_step()[1].p, li.jit(run_and_scale, static_argnums=2), jax.jit(run_and_scale, static_argnums=2)
    assert float(ours(p, 2.0, 5)) == pytest.approx(float(theirs(p, 2.0, 5)), rel=1e-15, abs=0)
    assert float(ours(p, factor=3.0)) == pytest.approx(float(theirs(p, factor=3.0)), rel=1e-15, abs=0)
    slope = jax.jit(jax.grad(run_and_scale))(p)
    for gradient in (li.jit(jax.grad(run_and_scale)), jax.grad(li.jit(run_and_scale)), jax.jit(jax.grad(ours))):
        np.testing.assert_allclose(gradient(p), slope, rtol=1e-13)
    assert ours.__name__ == "run_and_scale"


def test_li_jit_compiles_by_the_older_emitters_of_a_cpu_and_without_options_elsewhere(monkeypatch):
    given = []

    def recorded(function, compiler_options=None, **named):
        def call(*_, **__):
            given.append(compiler_options)

        return call

    monkeypatch.setattr(_compile, "_refused", set())  # jaxlib beyond 0.10 has refused them
    monkeypatch.setattr(jax, "jit", recorded)
    li.jit(run_and_scale)(1.0)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    li.jit(run_and_scale)(1.0)
    assert given == [{"xla_cpu_use_fusion_emitters": False}, None]


def test_an_option_unknown_to_xla_is_left_out(monkeypatch):
    monkeypatch.setattr(_compile, "_ONCE", {"xla_backend_optimization_level": 0, "xla_no_such_flag": False})
    monkeypatch.setattr(_compile, "_refused", set())
    assert _compile.compiled(lambda x: 2 * x, once=True)(1.5) == 3
    assert _compile._refused == {"xla_no_such_flag"}


@pytest.mark.long
def test_the_first_example_of_the_readme_compiles_its_run_once(caplog):
    readme = Path(__file__).parents[2] / "README.md"
    example = re.findall(r"```python\n(.*?)```", readme.read_text(encoding="utf-8"), re.S)[0]
    jax.clear_caches()
    first = programs(caplog, lambda: exec(example, {}))
    assert first.count("_trajectory") == 1
    assert not programs(caplog, lambda: exec(example, {}))


@pytest.fixture
def no_folder():
    before = {name: getattr(jax.config, name) for name in NAMES}
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # which JAX opens once


def test_programs_are_stored_in_the_user_s_cache_directory(no_folder, monkeypatch, tmp_path):
    monkeypatch.delenv("LIEINT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    use_program_cache()
    assert "lieint" in jax.config.jax_compilation_cache_dir


def test_a_custom_cache_folder_is_used(no_folder, monkeypatch, tmp_path):
    monkeypatch.setenv("LIEINT_CACHE", str(tmp_path))
    use_program_cache()
    assert jax.config.jax_compilation_cache_dir.startswith(str(tmp_path))


def test_a_read_only_cache_folder_is_read_and_not_written_to(no_folder, monkeypatch, tmp_path):
    for writable in (False, True):
        monkeypatch.setattr(os, "access", lambda *_, writable=writable: writable)
        folder = li.cache_programs(tmp_path)
        jax.jit(lambda x, k=float(writable): jnp.sin(x) @ jnp.cos(x - k))(jnp.ones((3, 3))).block_until_ready()
        assert any(folder.iterdir()) == writable


def test_lieint_cache_0_disables_the_cache(no_folder, monkeypatch):
    monkeypatch.setenv("LIEINT_CACHE", "0")
    use_program_cache()
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.long
def test_programs_are_loaded_by_the_next_process(tmp_path):
    """Also by one that has compiled something before it asks for the cache."""
    script = """
import sys, jax
import jax.numpy as jnp
import lieint_jax as li
jnp.arange(3) * 2
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("/cache_hits") else None)
folder = li.cache_programs(sys.argv[1])
body = li.systems.rigid_body([1.0, 2.0, 3.0])
li.integrate(li.schemes.so3_midpoint(body), body.state(angular_velocity=[0.2, 0.0, 1.0]), 0.1, 2)
print(len(hits), len(list(folder.iterdir())))
"""
    environment = {name: value for name, value in os.environ.items() if name.upper() not in map(str.upper, NAMES)}
    command = [sys.executable, "-c", script, str(tmp_path / "programs")]
    runs = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    (hits, kept), (hits_again, _) = ([int(x) for x in run.stdout.split()] for run in runs)
    assert not hits
    assert kept
    assert hits_again


def test_a_cache_folder_that_jax_was_given_is_not_replaced(monkeypatch, tmp_path):
    before = jax.config.jax_compilation_cache_dir
    assert before
    monkeypatch.setenv("LIEINT_CACHE", str(tmp_path))
    use_program_cache()
    assert jax.config.jax_compilation_cache_dir == before


@pytest.mark.long
def test_derivatives_outside_of_jit_go_through_the_package_s_own_programs():
    """JAX derives no program that has options for XLA: there the package's have none."""
    step, _, dt = a_step()

    def end(moments):
        body = li.systems.rigid_body(moments)
        start = body.state([0.8, 0.6, 0, 0], angular_velocity=[0.2, 0.1, 1.0])
        return li.integrate(li.schemes.so3_midpoint(body), start, dt, 3).state.q[-1, 1]

    moments = step.system.inertia
    eager, jitted = jax.grad(end)(moments), jax.jit(jax.grad(end))(moments)
    assert abs(eager - jitted).max() < 1e-13
    assert abs(jax.vmap(jax.grad(end))(moments[None])[0] - jitted).max() < 1e-13


def test_programs_of_functions_that_are_gone_are_freed(monkeypatch):
    """Each new function of a user kept some MiB for ever: XLA's program of a check, and what was walked."""
    monkeypatch.setattr(_reads, "_MOST_KEPT", 2)
    monkeypatch.setattr(_traced, "_MOST_KEPT", 2)
    monkeypatch.setattr(_traced, "_cache", {})
    check = _compile.compiled(lambda function, x: function(x), static_argnums=0, once=True)
    programs, functions = [], []

    def program_of(function, kinds, examples):
        return _traced.Traced(jax.make_jaxpr(function)(*examples), kinds)

    for k in range(6):
        function = lambda x, k=k: x + k  # noqa: E731
        assert check(function, jnp.ones(())) == 1 + k
        made = _traced.make_once(program_of, function, ("member",), (np.ones(()),))
        assert made.length == bool(k)
        programs.append(weakref.ref(made))
        functions.append(weakref.ref(function))
        del made, function
    gc.collect()
    assert [x() is not None for x in functions] == [False] * 4 + [True] * 2
    assert [x() is not None for x in programs] == [False] * 4 + [True] * 2


def in_threads(count, work):
    """What `work(k)` raised in any of so many threads, between which Python switches as often as it can."""
    errors, before, barrier = [], sys.getswitchinterval(), threading.Barrier(count)

    def run(k):
        barrier.wait()
        try:
            work(k)
        except Exception as error:  # which a thread only prints
            errors.append(repr(error))

    threads = [threading.Thread(target=run, args=(k,)) for k in range(count)]
    sys.setswitchinterval(1e-6)
    try:
        for act in (threading.Thread.start, threading.Thread.join):
            for thread in threads:
                act(thread)
    finally:
        sys.setswitchinterval(before)
    return errors


@pytest.mark.parametrize("most", [3, 100])
def test_threads_share_what_was_made(most):
    """Runs in several threads ended in RuntimeError or KeyError: each moved and dropped entries of one dictionary."""
    kept, found = _reads.Kept(), [{} for _ in range(8)]

    def work(k):
        for n in range(1500):
            key = "ab"[n % 2], n % 11
            found[k].setdefault(key, kept.get(key, object, most))

    assert not in_threads(8, work)
    if most == 100:  # nothing was dropped, so that all have the same
        assert all(own == found[0] for own in found)


def test_threads_call_one_compiled_function():
    """Its programs, one for each structure of its arguments, are stored for all threads."""
    total = _compile.compiled(lambda x: sum(x))

    def work(_):
        for n in range(40):
            assert total([np.float32(k) for k in range(n % 3 + 1)]) == (n % 3) * (n % 3 + 1) / 2

    assert not in_threads(4, work)


NEW = {  # of each, a system of a new function
    "torque": lambda k: li.systems.torqued_body([1.0, 2.0, 3.0], lambda t, q, omega: -k * omega),
    "potential": lambda k: li.systems.potential_top([1.0, 2.0, 3.0], lambda g: k * g[2]),
    "gravity": lambda k: li.systems.rigid_bodies(
        [1.0, 2.0], [[1.0, 2.0, 3.0]] * 2, lambda x, turns: -k / jnp.linalg.norm(x[1] - x[0])
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", NEW)
def test_checks_of_new_functions_keep_no_programs(monkeypatch, name):
    monkeypatch.setattr(_reads, "_MOST_KEPT", 1)
    motion = {"positions": np.eye(3)[:2], "velocities": np.zeros((2, 3))} if name == "gravity" else {}
    turn = {"angular_velocities": np.eye(3)[:2]} if name == "gravity" else {"angular_velocity": [0.1, 0.2, 0.3]}
    counts = []
    for k in range(1, 5):
        system = NEW[name](float(k))
        system.check(system.state(**motion, **turn))
        make = functools.partial(system.state, **motion)
        jax.vmap(lambda turn, make=make: make(**turn))(jax.tree.map(lambda x: np.stack([x, x]), turn))
        gc.collect()
        counts.append(len(jax.devices()[0].client.live_executables()))
    assert counts[-1] == counts[1], counts


def test_a_potential_s_parameter_may_be_varied():
    """A check of concrete bodies computed the energy inside of jit, and with tracers that the potential closes over."""

    def energy(k):
        bodies = NEW["gravity"](k)
        start = bodies.state(np.eye(3)[:2], velocities=np.zeros((2, 3)), angular_velocities=np.eye(3)[:2])
        bodies.check(jax.tree.map(np.asarray, fixed))
        return bodies.energy(start)

    fixed = NEW["gravity"](1.0).state(np.eye(3)[:2], velocities=np.zeros((2, 3)), angular_velocities=np.eye(3)[:2])
    one = energy(1.0)
    for value in jax.jit(energy)(1.0), jax.vmap(energy)(jnp.ones(2))[0]:
        assert abs(value - one) < 1e-15
    assert abs(jax.grad(energy)(1.0) + 1 / np.sqrt(2)) < 1e-15


@pytest.mark.long
@pytest.mark.parametrize("engine", ["integrate", "ensemble"])
def test_runs_of_new_functions_keep_few_of_them(monkeypatch, engine):
    """Each new function of a user kept some 10 MiB of jaxprs for ever, in caches of JAX and of machine code."""
    monkeypatch.setattr(_reads, "_MOST_KEPT", 1)
    monkeypatch.setattr(_traced, "_cache", {})
    kept = []
    for k in range(36):
        law = lambda g, k=k: k * g[2]  # noqa: E731
        body = li.systems.potential_top([1.0, 2.0, 3.0], law)
        step, start = li.schemes.splitting(body), body.state(angular_velocity=[0.1, 0.2, 0.3])
        if engine == "integrate":
            li.integrate(step, start, 0.1, 2)
        else:
            li.run(step, jax.tree.map(lambda x: x[None], start), 0.1, 2, progress=False, save_every=None)
        if k in (17, 35):
            gc.collect()
            kept.append(sum(isinstance(x, jax.extend.core.JaxprEqn) for x in gc.get_objects()))
    assert kept[1] < 1.05 * kept[0], kept
