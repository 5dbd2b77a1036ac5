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
    required = {tuple(re.fullmatch(r"([a-z0-9-]+)([<>=].*)", x).groups()) for x in PROJECT["dependencies"]}
    python = ("python", PROJECT["requires-python"])
    expected = {("matplotlib-base" if name == "matplotlib" else name, bound) for name, bound in {*required, python}}
    assert recipe == expected


def test_the_citation_and_the_recipe_name_the_last_release():
    """It has the newest dated section of the changelog; the package is of this version or, X.dev0, on the way to X."""
    citation = dict(line.split(": ", 1) for line in text("CITATION.cff").splitlines() if re.match(r"[a-z-]+: \S", line))
    sections = re.findall(r"^## \[([\d.]+)\] - (\S+)$", text("CHANGELOG.md"), re.M)
    coming = [version for version, date in sections if date == "unreleased"]
    assert sections[: len(coming)] == [(version, "unreleased") for version in coming]
    last, date = sections[len(coming)]
    assert (citation["version"], citation["date-released"]) == (last, date)
    assert f'version: "{last}"' in text("docs/conda/recipe.yaml")
    assert [li.__version__] == ([f"{version}.dev0" for version in coming] or [last])


def test_all_addresses_of_the_project_name_one_owner():
    """OWNER until a person fills it in, once: see docs/maintaining.md."""
    sources = ["pyproject.toml", "CITATION.cff", "docs/mkdocs.yml", "docs/maintaining.md", "docs/conda/recipe.yaml"]
    named = {
        name: set(re.findall(r"github\.com/([\w-]+)/lieint_jax|([\w-]+)\.github\.io", text(name))) for name in sources
    }
    owners = {name: {"".join(found) for found in pairs} for name, pairs in named.items()}
    assert len(set().union(*owners.values())) == 1, owners
    assert all(owners.values()), owners


def test_links_of_the_long_description_are_absolute_and_lead_to_files():
    """PyPI shows the README without the files next to it, so the build writes addresses for its links."""
    build = tomllib.loads(text("pyproject.toml"))["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    shown = text("README.md")
    for rule in build["substitutions"]:
        shown = re.sub(rule["pattern"], rule["replacement"], shown)
    links = re.findall(r"\]\(([^)#]+)", shown)
    assert len(links) > 15
    for link in links:
        kind, path = re.fullmatch(re.escape(PROJECT["urls"]["Source"]) + r"/(blob|raw)/HEAD/(.*)", link).groups()
        assert (ROOT / path).exists(), path
        assert (kind == "raw") == (Path(path).suffix in (".gif", ".png")), path
