"""float64 for every test but those that say otherwise; which tests run; and how their programs are compiled.

| command | tests | compiled |
|---|---|---|
| `pytest` | all but those marked `long`, and of each function marked `slow` the first case | quickly |
| `pytest --shard K/N` | the K-th of N parts of all tests | as a user's programs |
| `pytest --all-shards` | all | as a user's programs |

Most of a test's time is XLA's. Its older CPU emitters, which jaxlib has up to 0.10, compile in a third of the time of
its present ones, and without LLVM's optimizations in two thirds of that; the programs of one run serve the next from a
cache on disk. Shards run every test with default compiler options, and compare machine code with XLA.
"""

import ctypes
import gc
import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import jax
import pytest

gc.set_threshold(100_000, 50, 100)  # collecting the garbage of tracing took a fifth of its time
jax.config.update("jax_enable_x64", True)
hypothesis.settings.register_profile("house", deadline=None, max_examples=25, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("house")

QUICK = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_backend_optimization_level=0",
)
_LARGE = 3 * 2**30  # bytes
OPTIONS = {
    "jax_compilation_cache_dir": str(Path(__file__).parents[1] / ".jax_cache"),
    "jax_persistent_cache_min_compile_time_secs": 0.05,  # a program that compiles sooner costs more to write down
    "jax_persistent_cache_min_entry_size_bytes": -1,
    "jax_traceback_in_locations_limit": 0,  # fewer words in each program
}


def pytest_addoption(parser):
    parser.addoption("--shard", metavar="K/N", help="run the K-th of N parts of all tests, K from 1 to N")
    parser.addoption("--all-shards", action="store_true", help="run all tests, the long and the slow ones too")


def pytest_configure(config):
    """Before any test module is imported, so before XLA starts; processes that tests start inherit it."""
    if config.getoption("--shard"):
        _parts(config.getoption("--shard"))
    worker = hasattr(config, "workerinput")  # of pytest-xdist: it has the environment of the process that started it
    if not (worker or config.getoption("--shard") or config.getoption("--all-shards")):
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *_known(QUICK)]).strip()
    for name, value in OPTIONS.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


def pytest_runtest_setup(item):
    """`pytest` compares machine code with XLA in tests marked `compared` only, as that takes as long as their runs."""
    from internals import compare_machine_code

    all_compare = item.config.getoption("--shard") or item.config.getoption("--all-shards")
    compare_machine_code(all_compare or item.get_closest_marker("compared"))


@pytest.fixture
def fresh_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def lieint(capsys, fresh_folder):
    """Calls the command in a fresh folder: what it prints.

    `lieint.refuse` gives the error message of a call that ends with 2; `lieint.drew` asserts that files are pictures.
    """
    from lieint_jax.command import cli

    def end(code, arguments):
        capsys.readouterr()
        assert cli.main([str(x) for x in arguments]) == code
        return capsys.readouterr()

    def called(*arguments):
        return end(0, arguments).out

    def drew(*names):
        assert all(Path(name).read_bytes().startswith(b"\x89PNG") for name in names)

    called.drew = drew
    called.refuse = lambda *arguments: end(2, arguments).err
    return called


@pytest.fixture
def small_chunks(monkeypatch):
    """Commits after every 4 saves, so that a short run has many."""
    from internals import commit_every

    commit_every(monkeypatch, 4)


def pytest_runtest_logfinish():
    """A worker above 3 GiB clears its caches; four workers once filled 24 GiB."""
    if _resident() > _LARGE:
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # else glibc keeps what was freed


def _resident():
    """The memory of this process in bytes, on Linux with glibc; 0 elsewhere."""
    known = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "malloc_trim")
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if known else 0


def pytest_collection_modifyitems(config, items):
    if config.getoption("--all-shards"):
        return
    if config.getoption("--shard"):
        items[:], others = _shard(items, *_parts(config.getoption("--shard")))
    else:
        items[:], others = _sample(items)
    config.hook.pytest_deselected(items=others)


def _known(flags):
    """Those of the flags that this XLA has. It ends a process that sets any other, so other processes try them."""
    return flags if _starts(flags) else [flag for flag in flags if _starts([flag])]


def _starts(flags):
    environment = os.environ | {"XLA_FLAGS": " ".join(flags)}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return subprocess.run(command, env=environment, capture_output=True).returncode == 0


def _parts(text):
    """K and N of "K/N"."""
    k, _, n = text.partition("/")
    if not (k.isdecimal() and n.isdecimal() and 1 <= int(k) <= int(n)):
        raise pytest.UsageError(f"--shard takes K/N with 1 ≤ K ≤ N, such as 2/8; got {text!r}")
    return int(k), int(n)


def _shard(items, k, n):
    """Every n-th item: the cases of a function, which take about as long as one another, go to different shards."""
    return items[k - 1 :: n], [item for i, item in enumerate(items) if i % n != k - 1]


def _is_long(item):
    """Whether it is marked `long`, itself or with its file; one marked `quick` is not for its file's sake."""
    own = {mark.name for mark in item.own_markers}
    return "long" in own or ("quick" not in own and item.get_closest_marker("long") is not None)


def _sample(items):
    """All items but those marked `long`, and of each function marked `slow` the first case."""
    seen, kept, others = set(), [], []
    for item in items:
        function = (item.path, item.originalname)
        later = item.get_closest_marker("slow") and function in seen
        if _is_long(item) or later:
            others.append(item)
        else:
            seen.add(function)
            kept.append(item)
    return kept, others
