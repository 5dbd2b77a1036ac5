"""Texts of files that anybody may have written: what reaches a terminal is printable, on lines of bounded length."""

import ast
import json
import random
import shutil
import sys
import unicodedata
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from internals import write_root

import lieint_jax as li
from lieint_jax.command import cli

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


def shown(capsys, *arguments):
    """The exit code of a command and what it prints, which must be printable, line by line, and of bounded length."""
    code = cli.main(list(arguments))
    out = "".join(capsys.readouterr())
    allowed = {character for character in out if unicodedata.category(character) == "Zs"} | {"\n"}
    assert not {character for character in out if not (character.isprintable() or character in allowed)}
    assert "lieint: all is well" not in out.splitlines()
    assert max(map(len, out.splitlines())) < 4200, arguments
    return code, out


@pytest.mark.quick
def test_names_of_files_and_arguments_print_no_control_characters(capsys):
    odd = "a\x1b[2J\u202e\nb"
    Path(f"{odd}.zarr").mkdir()
    Path(f"{odd}.py").write_text("1 / 0")
    Path(f"{odd}.txt").write_bytes(bytes(range(256)))
    for arguments in (
        *([command, f"{odd}.zarr"] for command in ("info", "plot", "animate")),
        *([command, odd] for command in ("info", "plot", "animate", "run", "check", "list", "files")),
        ["files", f"{odd}.txt"],
        ["list", "toutatis", odd],
        ["run", "toutatis", "--members", odd],
        ["run", "toutatis", f"--{odd}"],
        ["check", "rigid_body", "--scheme", odd],
        [odd],
    ):
        code, out = shown(capsys, *arguments)
        assert (code, out.count("\n")) == (2, 1), (arguments, out)
        assert out.startswith("lieint: ")
    assert shown(capsys, "run", f"{odd}.py")[0] == 1


def stores_with(text):
    """Changes a good store so that one of its facts is an odd text or a huge number; yields the keys of the fact."""
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    step = li.schemes.so3_midpoint(BODY)
    li.run(step, states, 0.05, 4, save_every=2, store="good.zarr", progress=False)
    top = ((), *((key,) for key in ("title", "scheme", "system", "time_unit", "reduce", "dt", "leaves")))
    of_run = (("run", key) for key in ("device", "versions", "engine", "compiler_options", "epoch"))
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
            yield keys
            shutil.rmtree("odd.zarr")


def test_a_store_is_described_and_drawn_without_control_characters(capsys, monkeypatch):
    """Its pictures are those of any run, and are not drawn here."""
    titles = []
    monkeypatch.setattr(li.plots, "overview", lambda run, path, title: titles.append(title) or [path])
    described = drawn = 0
    for keys in stores_with(texts(4, surrogates=True)):
        described += shown(capsys, "info", "odd.zarr")[0] == 0
        drawn += shown(capsys, "plot", "odd.zarr", "--force")[0] == 0
        assert shown(capsys, "animate", "odd.zarr", "--out", "x.mp5")[0] == 2, keys
    assert described > 5
    assert drawn > 5
    assert all(character.isprintable() for title in titles for character in title)


def test_the_list_and_warnings_print_no_control_characters(capsys):
    assert shown(capsys, "list")[0] == 0
    with warnings.catch_warnings():  # the command has replaced how they are shown
        warnings.simplefilter("always")
        warnings.warn(WORST, stacklevel=1)
    assert "\x1b" not in capsys.readouterr().err


def test_the_library_and_the_command_print_in_one_place():
    """Examples print their own report, and nothing else prints."""
    root, prints = Path(li.__file__).parent, set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Name) and node.id == "print":
                prints.add(str(path.relative_to(root)))
    others = {name for name in prints if not name.startswith("examples/")}
    constant = {"command/entry.py", "runs/_execute.py"}  # what these print
    assert others == {"command/printer.py", *constant}
