"""The command line keeps compiled programs, where the user wants it and in a folder of this kind of processor."""

import jax
import pytest

from lieint_jax.command.compilation import keep_programs

NAMES = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


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
