"""What a release says of itself is the same in all of its files."""

import re
import tomllib
from pathlib import Path

import lieint_jax as li

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_conda_recipe_requires_what_the_package_requires():
    run = text("docs/conda/recipe.yaml").partition("  run:\n")[2].partition("\ntests:")[0]
    recipe = {tuple(line.split("- ")[1].split(" ")) for line in run.strip().splitlines()}
    required = {tuple(re.fullmatch(r"([a-z]+)(.*)", x).groups()) for x in PROJECT["dependencies"]}
    python = ("python", PROJECT["requires-python"])
    expected = {("matplotlib-base" if name == "matplotlib" else name, bound) for name, bound in {*required, python}}
    assert recipe == expected


def test_the_version_is_the_same_everywhere():
    assert f'version: "{li.__version__}"' in text("CITATION.cff") or f"version: {li.__version__}" in text(
        "CITATION.cff"
    )
    assert f'version: "{li.__version__}"' in text("docs/conda/recipe.yaml")
    heads = re.findall(r"^## \[(.*?)\]", text("CHANGELOG.md"), re.M)
    assert li.__version__ in heads[:2]
