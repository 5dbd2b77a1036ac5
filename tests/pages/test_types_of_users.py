"""A type checker finds the mistakes of a user's script, and knows the type of everything that README shows."""

import json
import re
import subprocess
import sys
from pathlib import Path

import data_files
import pytest
from documents import blocks

ROOT = Path(__file__).parents[2]
[(_, FIRST_STEPS), *_] = blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python")
SCRIPT = f"""
from concurrent.futures import ThreadPoolExecutor
{FIRST_STEPS}
pool = ThreadPoolExecutor(2)
top = li.systems.heavy_top([5.0, 5.0, 1.0], weight=[0.0, 0.0, 20.0])
certificate = li.diagnostics.certify(step, state, dt=0.05, num_steps=1000)
in_bath = li.schemes.langevin(body, temperature=1.0, friction=[0.1, 0.1, 0.2])
reduced = li.run(step, state, dt=0.05, num_steps=1000, reduce="energy", per="member")
found = li.fit(lambda guess: guess["mass"] - 1.0, {{"mass": 2.0}})
"""
TYPES, MISTAKES = data_files.table("types_of_users").values()


def by_pyright(path):
    """The lines with errors, and the revealed types by line."""
    pytest.importorskip("pyright")
    settings = {"include": [path.name], "extraPaths": [str(ROOT)], "pythonVersion": "3.11"}
    (path.parent / "pyrightconfig.json").write_text(json.dumps(settings), encoding="utf-8")
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", path.parent]
    found = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)["generalDiagnostics"]
    lines = [(x["severity"], x["range"]["start"]["line"] + 1, x["message"]) for x in found]
    types = {line: re.search('is "(.*)"', message)[1] for kind, line, message in lines if kind == "information"}
    return {line for kind, line, _ in lines if kind == "error"}, types


def by_mypy(path):
    """The same, of mypy."""
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", "--no-pretty", "--cache-dir", path.parent / "cache", path.name]
    told = subprocess.run(command, capture_output=True, text=True, cwd=path.parent, env={"MYPYPATH": str(ROOT)}).stdout
    lines = re.findall(r"^\w+\.py:(\d+): (\w+): (.*)$", told, re.M)
    types = {int(n): text.partition('"')[2].rpartition('"')[0] for n, kind, text in lines if "Revealed" in text}
    return {int(n) for n, kind, _ in lines if kind == "error"}, types


@pytest.mark.long
@pytest.mark.parametrize("checked", [by_pyright, by_mypy])
def test_a_type_checker_finds_the_mistakes_of_a_script_and_knows_its_types(checked, tmp_path):
    """Seven mistakes, each in a line of its own, and no other error; no type that is shown is Any."""
    path, start = tmp_path / "script.py", len(SCRIPT.splitlines()) + 1
    revealed = [f"reveal_type({expression})" for expression in TYPES]
    path.write_text(SCRIPT + "\n".join([*revealed, *MISTAKES.values()]), encoding="utf-8")
    wrong, types = checked(path)
    assert wrong == set(range(start + len(TYPES), start + len(TYPES) + len(MISTAKES)))
    assert len(types) == len(TYPES)
    shown = {expression: types[start + k] for k, expression in enumerate(TYPES)}
    if checked is by_pyright:
        assert shown == TYPES
    else:  # which writes a named tuple with the types of its fields
        names = {x: re.findall(r"\w+", TYPES[x])[0] for x in TYPES}
        assert [x for x, name in names.items() if name not in shown[x] or shown[x] == "Any"] == []
