"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
import pkgutil

import pytest

import lieint_jax as li

EXPENSIVE = ("normal_modes", "equilibrium", "langevin")


def examples():
    for info in pkgutil.walk_packages(li.__path__, "lieint_jax."):
        module = importlib.import_module(info.name)
        for test in doctest.DocTestFinder(exclude_empty=True).find(module, info.name):
            if test.examples:
                name = test.name.removeprefix("lieint_jax.")
                yield pytest.param(test, id=name, marks=[pytest.mark.long] * name.endswith(EXPENSIVE))


@pytest.mark.parametrize("example", list(examples()))
def test_the_example_of_a_docstring(example):
    results = doctest.DocTestRunner().run(example)
    assert results.attempted >= 1
    assert results.failed == 0


def test_all_docstrings_with_a_prompt_are_found():
    from pathlib import Path

    prompts = sum(path.read_text(encoding="utf-8").count(">>> ") for path in Path(li.__file__).parent.rglob("*.py"))
    found = sum(len(param.values[0].examples) for param in examples())
    assert found == prompts
