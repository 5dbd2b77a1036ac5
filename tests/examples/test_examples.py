"""Every example is a script that can be copied, and prints the values of the nominal member that were kept of it."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from kept_values import KEPT, assert_lines_are_kept, is_same

import lieint_jax as li
from lieint_jax import examples

NAMES = sorted(module.name for module in pkgutil.iter_modules(examples.__path__))
ARGUMENTS = {  # of the runs whose values were kept: the script and its options
    "toutatis_takahashi": ("toutatis", "--start", "takahashi"),
    "gyro": ("gyro", "--trials", "12"),
    "kappa": ("kappa", "--training", "20", "--unseen", "50", "--runs", "4"),
    "material": ("material", "--observations", "20"),
    "sensitivity": ("sensitivity", "--steps", "4000"),
}
FEW = {"pluto_charon": 1, "driven": 1}  # members; further ones of `driven` move chaotically
NUMBER = r"([-−]?\d+(?:\.\d+)?(?:e[-+]\d+)?)(?=  | ±| +[-−]?\d|$)"  # the first one of a row
ROW = re.compile(rf"^  (  )?(?!published: )(\S.*?)(?:  +| +(?=[-−]?\d+\.\d{{4}})){NUMBER}")
COMPARED = sorted(KEPT.keys() - {"maclaurin", "satellite_fit", "toutatis_fit"})  # which have tests of their own


def nominal_values(text):
    """The values of the nominal member in the table of a report, by the names of its rows.

    The name of an indented row begins with that of the row above, to which it belongs.
    """
    found, inside, above = {}, False, ""
    for line in text.splitlines():
        if "nominal" in line.split():
            inside = True
        elif inside and (row := ROW.match(line)):
            name = " ".join(row[2].split())
            above = above if row[1] else name
            found[f"{above}: {name}" if row[1] else name] = row[3].replace("−", "-")
        elif inside and not line.strip():
            inside = False
    return found


def source(name):
    return Path(examples.__path__[0], f"{name}.py")


def run(name, folder, *arguments):
    command = [sys.executable, "-m", f"lieint_jax.examples.{name}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=1800, check=False)


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_a_script_on_public_names(name):
    nodes = list(ast.walk(ast.parse(source(name).read_text(encoding="utf-8"))))
    imported = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    assert not any(module.startswith("lieint_jax") for module in imported), "write `import lieint_jax as li`"
    private = {node.attr for node in nodes if isinstance(node, ast.Attribute) and node.attr.startswith("_")}
    assert private <= {"_replace"}, "the one public method of named tuples with such a name"


@pytest.mark.parametrize("name", NAMES)
def test_an_example_explains_itself_and_its_arguments(name):
    module = importlib.import_module(f"lieint_jax.examples.{name}")
    title = module.__doc__.splitlines()[0]
    assert title.endswith(".")
    assert ":" in title
    parameters, about = inspect.signature(module.main).parameters, inspect.getdoc(module.main)
    for parameter in parameters.values():
        assert parameter.annotation is not parameter.empty
        assert parameter.default is not parameter.empty
        assert re.search(rf"^    {parameter.name}: ", about, re.M), f"{parameter.name} is not explained"


@pytest.mark.parametrize("name", NAMES)
def test_importing_an_example_does_not_choose_a_precision(name):
    body = ast.parse(source(name).read_text(encoding="utf-8")).body
    assert not any("config" in ast.unparse(node) for node in body if not isinstance(node, ast.FunctionDef))
    [main] = [node for node in body if isinstance(node, ast.FunctionDef) and node.name == "main"]
    assert ast.unparse(main.body[1]) == "jax.config.update('jax_enable_x64', True)"


@pytest.mark.long
@pytest.mark.parametrize("kept", COMPARED)
def test_nominal_values_are_those_that_were_kept(kept, tmp_path):
    name, *options = ARGUMENTS.get(kept, (kept,))
    arguments = inspect.signature(importlib.import_module(f"lieint_jax.examples.{name}").main).parameters
    few = {"members": ("--members", str(FEW.get(kept, 3)))}
    few |= {"pictures": ("--no-pictures",), "certificate": ("--no-certificate",)}
    options += [word for argument, words in few.items() if argument in arguments for word in words]
    done = run(name, tmp_path, *options)
    assert done.returncode == 0, done.stderr
    found, wanted = nominal_values(done.stdout), KEPT[kept]
    for row in wanted.keys() - {"lines"}:
        assert is_same(found.get(row, "nan"), wanted[row]), f"{row}, kept as {wanted[row]}, in\n{done.stdout}"
    assert_lines_are_kept(kept, done.stdout)
    if (store := tmp_path / f"{name}.zarr").exists():  # a study has none
        assert np.all(li.open(store).converged)
