"""Sentences of errors that no other test meets: what was given, what is allowed, what to do."""

import io
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import internals
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import _cache, _checks
from lieint_jax.command import cli
from lieint_jax.core import State, StepInfo
from lieint_jax.examples import heavy_top
from lieint_jax.runs import _devices
from lieint_jax.runs import store as archives
from lieint_jax.runs.store import _identity

ONE = np.array([1.0, 0.0, 0.0, 0.0])
BODY = li.systems.RigidBody(jnp.array([1.0, 2.0, 3.0]))
STATE = State(jnp.array(ONE), jnp.array([0.2, 0.4, 3.0]))


SENTENCES = [
    (lambda: archives.load_store(Path("group.zarr")), "a Zarr group, but was not written by lieint"),
    (
        lambda: archives.load_store(Path("newer.zarr")),
        "format 99, that of a newer lieint_jax; this one reads format 8",
    ),
    (
        lambda: archives.load_store(Path("older.zarr")),
        "format 7, that of an older lieint_jax; this one reads format 8",
    ),
    (lambda: archives.load_store(Path("oldest.zarr")), "has format 1, that of an older lieint_jax"),
    (lambda: archives.load_store(Path("damaged.zarr")), "is damaged: its checksum is wrong"),
]


@pytest.fixture
def unusable(tmp_path, monkeypatch):
    """A folder of results that cannot be used."""
    monkeypatch.chdir(tmp_path)
    attributes = {
        "group": {},
        "newer": {"progress": 1, "format": 99},
        "older": {"progress": 1, "format": 7},
        "oldest": {"progress": 1},
        "damaged": {"progress": 1, "format": 8, "checksum": "0"},
    }
    for name, found in attributes.items():
        Path(f"{name}.zarr").mkdir()
        Path(f"{name}.zarr/zarr.json").write_text(json.dumps({"attributes": found}), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.usefixtures("unusable")
@pytest.mark.parametrize(("call", "sentence"), SENTENCES, ids=[sentence[:30] for _, sentence in SENTENCES])
def test_bad_arguments_raise_an_error_that_names_them(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


STEP, ONE_MEMBER = li.schemes.so3_midpoint(BODY), jax.tree.map(lambda x: x[None], STATE)
SIZES = [
    (
        lambda: li.integrate(STEP, STATE, 0.1, 2**31),
        "would hold 157 GB in memory, 2 times .*give a larger save_every, or",
    ),
    (
        lambda: li.run(STEP, ONE_MEMBER, 0.1, 2**31, save_every=1),
        r"would hold 174 GB in memory: 2147483649 entries of 81 bytes, .*has 1 GB; use a larger save_every or store=",
    ),
    (
        lambda: li.run(STEP, ONE_MEMBER, 0.1, 2**31, save_every=1, reduce="energy"),
        "would hold 120 GB .*save_every$",
    ),
    (
        lambda: li.run(STEP, ONE_MEMBER, 0.1, 2**31, save_every=1, store="x.zarr"),
        "would hold 34.4 GB .*save_every$",
    ),
    (lambda: li.integrate(STEP, STATE, 0.1, 2**63), "num_steps must be at most 9007199254740992, got 9.22337e"),
    (
        lambda: li.run(STEP, ONE_MEMBER, 0.1, 10**30, save_every=None),
        "num_steps must be at most 9007199254740992, got 1e",
    ),
    (
        lambda: li.run(STEP, ONE_MEMBER, 0.1, 1e30, save_every=None),
        "num_steps must be an integer ≥ 0, got 1e",
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("call", "sentence"), SIZES, ids=[sentence[:30] for _, sentence in SIZES])
def test_a_size_is_refused_before_it_is_allocated(call, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    internals.memory_of(monkeypatch, 1e9)
    with pytest.raises(ValueError, match=sentence):
        call()
    assert not list(tmp_path.iterdir())


def test_the_memory_of_this_machine_is_known_and_sizes_are_spelled():
    assert 2**28 < _checks.memory_of_machine() < 2**50
    assert [_checks.spoken_size(x) for x in (81, 4.2e6, 1.4e11)] == ["81 bytes", "4.2 MB", "140 GB"]
    assert _checks.entry_size(STATE) == 8 * 7 + 9


def test_a_custom_step_that_fails_has_a_message():
    @li.pytree
    class Failing(li.Step):
        system: li.systems.RigidBody
        order, symmetric, name = 1, True, "failing"

        def advance(self, state, dt):
            return state, StepInfo(jnp.ones(()), jnp.zeros((), bool))

    with pytest.raises(
        ValueError, match=r"failing does not converge at dt = 0.1, nor at a smaller dt down to 0.0001: a potential"
    ):
        Failing(BODY).check(STATE, 0.1)


@pytest.mark.parametrize(
    ("owners", "others"),
    [([0, 1, 0], "1"), ([1, 2], "1, 2")],
)
def test_a_mesh_has_devices_of_this_process_only(monkeypatch, owners, others):
    class Mesh:
        axis_names = ("members",)
        devices = np.array([SimpleNamespace(process_index=owner) for owner in owners])

    monkeypatch.setattr(_devices, "Mesh", Mesh)
    with pytest.raises(ValueError, match=f"of this process only, number 0, got some of processes {others}: .*part="):
        _devices.checked_mesh(Mesh())  # pyright: ignore[reportArgumentType]


def test_an_interrupted_run_in_memory_suggests_a_store(monkeypatch):
    internals.interrupt_after_the_first_call(monkeypatch)
    states = jax.tree.map(lambda x: x[None], STATE)
    with pytest.raises(KeyboardInterrupt, match="stopped after 6 of 6 steps; a run with a store can be resumed"):
        li.run(li.schemes.so3_midpoint(BODY), states, 0.1, 6, progress=False, save_every=None)


def test_the_command_ends_quietly(monkeypatch, capsys):
    """Where its reader has gone, and where it is interrupted."""

    def stopped_by(error):
        def main():
            raise error

        monkeypatch.setattr(heavy_top, "main", main)
        return cli.main(["run", "heavy_top"])

    assert stopped_by(KeyboardInterrupt()) == 130
    assert stopped_by(KeyboardInterrupt("stopped after 3 of 9 steps")) == 130
    assert capsys.readouterr().err == "lieint: interrupted\nlieint: stopped after 3 of 9 steps\n"
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", io.StringIO())
        assert stopped_by(BrokenPipeError()) == 1


def test_a_script_whose_reader_has_gone_ends_quietly(fresh_folder):
    Path("many.py").write_text("def main():\n    for k in range(10**6):\n        print(k)\n")
    command = [sys.executable, "-m", "lieint_jax.command.cli", "run", "many.py"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "0\n"
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(timeout=60) == 1


def test_a_store_of_initial_states_is_not_drawn(tmp_path, lieint):
    li.run(STEP, ONE_MEMBER, 0.1, 0, store="start.zarr", progress=False)
    assert "start.zarr holds the initial states only: there is nothing to draw yet" in lieint.refuse(
        "plot", "start.zarr"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["start.zarr"]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_output_adapts_to_any_encoding(encoding, monkeypatch):
    """As of LC_ALL=C: letters that an encoding does not have are spelled."""
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding=encoding))
    assert cli.main(["--help"]) == 0
    print("κ ± 3° · π² − Ωₖ ≤ … 水", flush=True)
    [*_, last] = written.getvalue().decode(encoding).splitlines()
    spelled = {"ascii": "kappa +- 3deg * pi2 - Omegak <= ... ?", "latin-1": "kappa ± 3° · pi² - Omegak <= ... ?"}
    assert last == spelled.get(encoding, "κ ± 3° · π² − Ωₖ ≤ … 水")


def test_errors_of_the_system_are_one_short_line(monkeypatch, lieint):
    def failing(error):
        def main():
            raise error

        monkeypatch.setattr(heavy_top, "main", main)
        [line] = lieint.refuse("run", "heavy_top").splitlines()
        return line

    assert failing(OSError(36, "File name too long", "a" * 3000)) == f"lieint: {'a' * 100}…: File name too long"
    assert failing(OSError(28, "No space left on device")) == "lieint: No space left on device"
    assert failing(ValueError("two\nlines")) == "lieint: two lines"
    assert failing(MemoryError()).startswith("lieint: not enough memory: use fewer members")
    assert failing(jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")) == failing(MemoryError())
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        failing(jax.errors.JaxRuntimeError("INTERNAL: a mistake"))


def test_a_machine_without_a_description_of_its_processor_has_a_name(monkeypatch):
    def unreadable(*_, **__):
        raise OSError

    monkeypatch.setattr(Path, "read_text", unreadable)
    assert _cache._processor()
    assert _identity.device() == _cache.platform.machine()


def _drag_with_a_corner(t, q, omega):
    return -0.1 * omega * jnp.sqrt(omega @ omega)


def _narrow_torque(t, q, omega):
    return (-0.1 * jnp.sin(omega)).astype(jnp.float32)


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "Omega", "message"),
    [
        (_drag_with_a_corner, [0.0, 0, 0], "the torque _drag_with_a_corner has no finite derivative by .* no smaller"),
        (_narrow_torque, [0.1, 0.2, 0.3], "the torque _narrow_torque returns float32, so that no step converges"),
    ],
)
def test_a_step_that_no_smaller_dt_helps_names_the_function_and_the_cure(law, Omega, message):
    body = li.systems.torqued_body([1.0, 2.0, 3.0], li.torques.viscous(0.1) + law)
    state = body.state(angular_velocity=Omega)
    step = li.schemes.torqued_midpoint(body)
    for run in (li.integrate, li.run):
        states = state if run is li.integrate else jax.tree.map(lambda x: jnp.stack([x, x]), state)
        with pytest.raises(ValueError, match=message) as failed:
            run(step, states, 0.1, 2)
        assert "Use a smaller dt" not in str(failed.value)


def test_a_printable_value_is_escaped_and_cut():
    assert _checks.printable("κ = 1\u202f°\x1b\u202e\n\ud800") == "κ = 1\u202f°\\x1b\\u202e\\n\\ud800"
    assert _checks.printable("x" * 201) == "x" * 200 + "…"
    assert _checks.printable([1.0, "\x1b"]) == "[1.0, '\\x1b']"
    assert len(_checks.printable([0] * 3_000_000)) == 201
    assert _checks.printable(1 << 10**5) == "a value of too many digits"
