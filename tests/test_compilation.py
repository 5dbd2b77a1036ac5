"""A step made again compiles nothing, and the command line keeps compiled programs, in a folder of this processor."""

import re
from pathlib import Path

import jax
import pytest

import lieint_jax as li
from lieint_jax.command.compilation import keep_programs

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


@pytest.mark.slow
@pytest.mark.parametrize(
    "call",
    [
        lambda s, z, dt: li.integrate(s, z, dt, 6, 3),
        lambda s, z, dt: li.studies.observe(s, z, dt, [0.3, 0.7]),
        lambda s, z, dt: jax.grad(lambda h: li.studies.observe(s, z, h, [0.3, 0.7])[0].q[-1, 0])(dt),
        pytest.param(
            lambda s, z, dt: li.studies.observe(s, z, dt, [6 * dt, 14.2 * dt], derivative="checkpoint"),
            marks=pytest.mark.long,  # the numbers of steps are compiled in
        ),
        pytest.param(lambda s, z, dt: li.studies.reversible(s, z, dt, 6, 3), marks=pytest.mark.long),
        pytest.param(lambda s, z, dt: li.studies.round_trip_error(s, z, dt, 6), marks=pytest.mark.long),
        pytest.param(lambda s, z, dt: li.diagnostics.poisson_error(s, z, dt, 6), marks=pytest.mark.long),
        pytest.param(lambda s, z, dt: li.diagnostics.order(s, z, dt), marks=pytest.mark.long),
        pytest.param(lambda s, z, dt: s.system.solution(z, dt), marks=pytest.mark.long),
    ],
)
def test_a_step_made_again_with_other_numbers_compiles_nothing(caplog, call):
    if not programs(caplog, lambda: call(*a_step())):  # another test of this process had it compiled
        jax.clear_caches()
        assert programs(caplog, lambda: call(*a_step()))
    assert not programs(caplog, lambda: call(*a_step(0.04)))


@pytest.mark.long
def test_the_first_example_of_the_readme_compiles_its_run_once(caplog):
    readme = Path(__file__).parents[1] / "README.md"
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


def test_programs_are_kept_under_the_user_s_cache_directory(no_folder, monkeypatch, tmp_path):
    monkeypatch.delenv("LIEINT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keep_programs()
    assert "lieint" in jax.config.jax_compilation_cache_dir


def test_a_folder_of_one_s_own(no_folder, monkeypatch, tmp_path):
    monkeypatch.setenv("LIEINT_CACHE", str(tmp_path))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir.startswith(str(tmp_path))


def test_0_turns_it_off(no_folder, monkeypatch):
    monkeypatch.setenv("LIEINT_CACHE", "0")
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_jax_was_given_stays(monkeypatch, tmp_path):
    before = jax.config.jax_compilation_cache_dir
    assert before
    monkeypatch.setenv("LIEINT_CACHE", str(tmp_path))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir == before
