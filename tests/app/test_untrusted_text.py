"""Texts of files that anybody may have written: what reaches a terminal is printable, and no TOML file stops Python."""

import ast
import json
import random
import shutil
import sys
import time
import tracemalloc
import unicodedata
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
import scenario_files
from internals import write_root

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import cli
from lieint_jax.runs import store as archives
from lieint_jax.types import State, StepInfo, Trajectory

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
CONTROL = [chr(c) for c in range(sys.maxunicode + 1) if unicodedata.category(chr(c)) in ("Cc", "Cf", "Zl", "Zp")]
WORST = "\x1b]0;owned\x07\x1b[2J\u202egnp.txt\n\rlieint: all is well\u2028\x9b31m"

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("fresh_folder")]


def texts(seed, surrogates=False):
    """Texts with control and format characters, and one longer than any line."""
    draw = random.Random(seed)
    among = CONTROL + ["\ud800", "\udfff"] * surrogates
    yield WORST
    yield "\x1b[1m" + "long" * 5000
    while True:
        yield "".join(draw.choice(["a", " ", "é", draw.choice(among)]) for _ in range(draw.randrange(1, 40)))


def quoted(text):
    """A text as a string of TOML."""
    return '"' + "".join(f"\\U{ord(c):08x}" if c in '"\\$' or not c.isprintable() else c for c in text) + '"'


def shown(capsys, *arguments):
    """The exit code of a command and what it prints, which must be printable, line by line, and of bounded length."""
    code = cli.main(list(arguments))
    out = "".join(capsys.readouterr())
    allowed = {character for character in out if unicodedata.category(character) == "Zs"} | {"\n"}
    assert not {character for character in out if not (character.isprintable() or character in allowed)}
    assert "lieint: all is well" not in out.splitlines()
    assert max(map(len, out.splitlines())) < 4200, arguments
    return code, out


def test_a_report_of_a_scenario_prints_no_control_characters(capsys):
    """A run with odd texts in every key that is printed: title, unit, sources, remarks and labels."""
    text = texts(1)
    for _ in range(2):
        title, unit, source, remark, label = (quoted(next(text)) for _ in range(5))
        more = f"""seed = 1
sources = {{{source} = {label}}}
about = {remark}
published.precession_period = {{value = 1.0, error = 1e-9, source = {source}, remark = {remark}}}
[[observation]]
t = 10.0
label = {label}
source = {source}
euler_313_deg = [1.0, 2.0, 3.0]
angular_velocity_deg = [1.0, 2.0, 3.0]"""
        lines = dict(title=f"title = {title}", time_unit=f"time_unit = {unit}", seed=more)
        short = dict(steps="steps = 100", save_every="save_every = 10", members="members = 4")
        Path("odd.toml").write_text(scenario_files.book(**short, **lines), encoding="utf-8")
        assert quoted(scenarios.load("odd.toml").title) == title  # the data are the file's own
        code, out = shown(capsys, "run", "odd.toml", "--no-pictures", "--no-certificate", "--out", "odd.npz")
        assert code == 0, out
        assert shown(capsys, "info", "odd.npz")[0] == 0
        Path("odd.npz").unlink()


def test_errors_of_scenario_files_print_no_control_characters(capsys):
    text = texts(2)
    for _ in range(12):
        given = next(text)
        odd = quoted(given)
        for key, line in (
            ("system", f"system = {odd}"),
            ("scheme", f"scheme = {odd}"),
            ("seed", f"{odd} = 1"),
            ("seed", f"published.{odd} = 1"),
            ("seed", f"sources = {{{odd} = 1}}"),
            ("seed", f'published.precession_period = {{value = 1.0, source = {odd}}}\nsources = {{x = ""}}'),
            ("dt", f"dt = {odd}"),
            ("inertia", f"inertia = [{odd}]"),
            ("angular_velocity_deg", f"{odd} = 1.0"),
            ("angular_velocity_deg", f"inertia = {odd}"),
            ("angular_velocity_deg", f"inertia = [{odd}]"),
            ("title", f'title = "a"\n{odd} = 1\n{odd} = 2'),
            ("title", f"title = {given}"),
        ):
            Path("odd.toml").write_text(scenario_files.book(**{key: line}), encoding="utf-8")
            code, out = shown(capsys, "run", "odd.toml")
            assert code == 2
            assert out.count("\n") == 1
            assert out.startswith("lieint: odd.toml")


@pytest.mark.quick
def test_names_of_files_and_arguments_print_no_control_characters(capsys):
    odd = "a\x1b[2J\u202e\nb"
    Path(f"{odd}.npz").write_bytes(b"no archive")
    for arguments in (["info", f"{odd}.npz"], ["run", odd], ["check", odd], ["list", odd]):
        assert shown(capsys, *arguments)[0] == 2
    with pytest.raises(SystemExit):
        cli.main(["list", "toutatis", odd])
    assert "\x1b" not in capsys.readouterr().err


def test_info_of_an_archive_prints_no_control_characters(capsys):
    text = texts(3, surrogates=True)
    run = Trajectory(
        np.array([0.0, 0.5]),
        State(np.ones((2, 3, 4)), np.ones((2, 3, 3))),
        StepInfo(np.zeros((2, 3)), np.ones((2, 3), bool)),
    )
    for _ in range(12):
        odd = next(text)
        for metadata in (
            {"lieint_jax": odd},
            {"lieint_jax": "1", "title": odd},
            {"lieint_jax": "1", "scenario": {"title": odd, "time_unit": odd}},
            {"lieint_jax": "1", "scenario": {"title": odd, "system": odd, "members": 3, "steps": 1, "save_every": 1}},
            {"lieint_jax": odd, "jax": odd, "study": "gyro", "quick": True, "tree": 3},
            {"lieint_jax": "1", "jax": "1", "study": odd, "quick": True, "tree": 3},
            {"lieint_jax": "1", odd: 1, "title": {odd: [odd]}},
        ):
            archives.write_trajectory(Path("odd.npz"), run, metadata)
            shown(capsys, "info", "odd.npz")
            Path("odd.npz").unlink()
        name = odd[:50].encode(errors="ignore").decode().translate({0: None, ord("/"): None})
        np.savez("odd.npz", **{f"p{name}": np.zeros(3)})
        assert shown(capsys, "info", "odd.npz")[0] == 2
        Path("odd.npz").unlink()


def test_info_of_a_store_prints_no_control_characters(capsys):
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    step = li.schemes.so3_midpoint(BODY)
    li.run(step, states, 0.05, 4, save_every=2, store="good.zarr", progress=False)
    text = texts(4, surrogates=True)
    top = ((), *((key,) for key in ("title", "scheme", "system", "time_unit", "reduce", "dt", "leaves")))
    of_run = (("run", key) for key in ("device", "versions", "engine", "compiler_options"))
    for keys in (*top, *of_run, ("description", "system")):
        for odd in (next(text), 10**400):
            shutil.copytree("good.zarr", "odd.zarr")
            file = Path("odd.zarr/zarr.json")
            root = json.loads(file.read_text())
            table = root["attributes"]
            for key in keys[:-1]:
                table = table[key]
            put = {str(odd)[:300]: odd} if keys[-1:] in (("versions",), ("compiler_options",)) else odd
            table[keys[-1] if keys else "more"] = put
            if keys == ("run", "compiler_options"):
                table["engine"] = "xla"
            write_root(file, root)
            shown(capsys, "info", "odd.zarr")
            shutil.rmtree("odd.zarr")


def test_list_and_warnings_print_no_control_characters(capsys):
    assert shown(capsys, "list")[0] == 0
    with warnings.catch_warnings():  # the command has replaced how they are shown
        warnings.simplefilter("always")
        warnings.warn(WORST, stacklevel=1)
    assert "\x1b" not in capsys.readouterr().err


def test_the_application_prints_in_one_place_and_one_module_reads_toml():
    root = Path(li.__file__).parent
    prints, readers = set(), set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Name) and node.id == "print":
                prints.add(str(path.relative_to(root)))
            if isinstance(node, ast.Import) and "tomllib" in {alias.name for alias in node.names}:
                readers.add(str(path.relative_to(root)))
    assert prints == {"app/printer.py", "runs/_job/processes.py", "runs/_host/execute.py"}  # the last: a constant
    assert readers == {"runs/_storage/untrusted.py"}


N = 2**17
BOMBS = {
    "100 000 brackets": "a = " + "[" * 100_000,
    "closed brackets": "a = " + "[" * 100_000 + "]" * 100_000,
    "3000 inline tables": "a = " + "{a = " * 3000 + "1" + "}" * 3000,
    "17 arrays": "a = " + "[" * 17 + "]" * 17,
    "brackets after a string": 'b = \'\'\'[\'\'\' \nc = """a"""""\na = ' + "[" * 5000,
    "brackets after an escape": 'b = "\\"["\na = ' + "[" * 5000,
    "a key of 20 000 parts": ".".join("a" * 20_000) + " = 1",
    "a table of 20 000 parts": "[" + ".".join("a" * 20_000) + "]",
    "a key with spaces and quotes": " . ".join(["'a.b'"] * 20_000) + " = 1",
    "a key of parts in a table": "a = {" + ".".join("a" * 20_000) + " = 1}",
    "a key of 17 parts": ".".join("a" * 17) + " = 1",
    "10⁶ commas": "a = [" + "," * 10**6,
    "commas": "a = [" + "," * N,
    "3·10⁶ numbers": "dt = [" + "0.1, " * 3_000_000 + "]",
    "numbers": "dt = [" + "0, " * (N // 3) + "]",
    "many keys": "\n".join(f"k{i} = 1" for i in range(N // 10)),
    "many tables": "\n".join(f"[k{i}]" for i in range(N // 10)),
    "many tables in a list": "[[a]]\n" * (N // 6),
    "deep tables": "\n".join("[" + ".".join("a" * 15) + f".k{i}]" for i in range(N // 40)),
    "a long integer": "dt = " + "9" * N,
    "10⁶ digits": "dt = " + "9" * 10**6,
    "a hexadecimal step": scenario_files.book(dt="dt = 0x" + "f" * N),
    "a hexadecimal seed": scenario_files.book(seed="seed = 0x" + "f" * N),
    "a hexadecimal moment": scenario_files.book(inertia="inertia = [1.0, 2.0, 0x" + "f" * N + "]"),
    "a hexadecimal spread": scenario_files.book(angular_velocity_deg="inertia = 0x" + "f" * N),
    "a long string": 'dt = "' + "x" * N + '"',
    "a string of 10⁶": 'dt = "' + "x" * 10**6 + '"',
    "a long key": "k" * N + " = 1",
    "a string without end": 'title = "' + "x" * N,
    "quotes without end": 'title = """' + '"\\n' * (N // 4),
    "apostrophes without end": "title = '''" + "' " * (N // 4),
    "a table without end": "[" + "a" * N,
    "an inline table without end": "a = {b = [{c = ",
    "comments": "#\n" * (N // 2) + "[[",
    "lines": "\n" * N + "=",
    "null characters": "\0" * N,
    "control characters": "\x1b" * N,
    "carriage returns": "a = 1\r" * 100,
    "a key without a value": "a",
    "bytes": b"\xff" * N,
}


@pytest.mark.quick
@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_no_toml_file_stops_python(name, capsys):
    """One line, quickly and in little memory: 0.1 s and a few MB of an idle core for the slowest."""
    given = BOMBS[name]
    Path("bomb.toml").write_bytes(given if isinstance(given, bytes) else given.encode())
    scenarios.kinds()  # whose import is not measured
    tracemalloc.start()
    begun = time.process_time()
    code = cli.main(["run", "bomb.toml"])
    seconds, memory = time.process_time() - begun, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    error = capsys.readouterr().err
    assert code == 2
    assert error.startswith("lieint: bomb.toml")
    assert error.count("\n") == 1
    assert len(error) < 1500
    assert seconds < 5  # of processor time, traced
    assert memory < 60e6


def test_honest_toml_is_read():
    """At the limits: 16 brackets, keys of 16 parts, marks in strings and comments, and 9000 times."""
    many = "".join(f"{k / 7!r}, " for k in range(9000))
    text = f"""a = {"[" * 16}{"]" * 16} # {"[" * 99}
{".".join("b" * 16)} = "{"[.{" * 50}"
c = '''{"[.'" * 50}'''
d = \"\"\"{'[." ' * 50}\"\"\"\"\"
f.g = [{many}]
"""
    Path("a.toml").write_text(text)
    found = archives.read_toml(Path("a.toml"), "a.toml")
    assert found["c"] == "[.'" * 50
    assert len(found["f"]["g"]) == 9000
    for name in scenarios.scenario_names():
        assert scenarios.load(name).members > 0
