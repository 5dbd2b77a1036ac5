"""The pages of the site are true: their Python runs and prints what they show, their commands and scenarios parse."""

import ast
import contextlib
import io
import re
import runpy
import shlex
import types
from pathlib import Path

import jax
import pytest
from documents import blocks, words

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import cli, meshes

PAGES = Path(__file__).parents[2] / "docs" / "pages"
TEXTS = {path.relative_to(PAGES).as_posix(): path.read_text(encoding="utf-8") for path in sorted(PAGES.rglob("*.md"))}
PYTHON = {name: blocks(text, "python", "text") for name, text in TEXTS.items() if blocks(text, "python")}
LONG = {  # expensive pages, which run in shards
    "faq.md",
    "install.md",
    "why.md",
    *(f"howto/{x}.md" for x in ("bodies", "chaos", "fits", "group", "output", "potential", "rates", "rods")),
    *(f"howto/{x}.md" for x in ("sampling", "satellite", "scheme", "shape", "system", "tides", "torque")),
    *(f"howto/{x}.md" for x in ("covariance", "equilibria", "kalman", "optimal_control")),
    "tutorials/own_flyby.md",
}


@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.long] if x in LONG else []) for x in PYTHON])
def test_the_python_of_a_page_runs_and_prints_the_shown_output(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = types.ModuleType("page")
    following = [*PYTHON[name][1:], ("", "")]
    for (language, code), (next_language, shown) in zip(PYTHON[name], following, strict=True):
        if language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(code, name, "exec"), vars(module))
            if next_language == "text":
                assert words(printed.getvalue()) == words(shown)
    assert jax.config.jax_enable_x64


@pytest.mark.parametrize("name", PYTHON)
def test_the_python_of_a_page_can_be_pasted_at_the_prompt(name):
    """Before Python 3.13 the prompt needs a blank line between a compound statement and the next one."""
    for language, code in PYTHON[name]:
        if language == "python":
            lines, statements = code.splitlines(), ast.parse(code).body
            compound = [x for x in statements[:-1] if isinstance(x, ast.For | ast.While | ast.With | ast.If | ast.Try)]
            assert not [lines[x.lineno - 1] for x in compound if lines[x.end_lineno].strip()]


def test_the_drag_of_the_page_on_torques_has_a_derivative_at_rest():
    page = ast.parse(PYTHON["howto/torque.md"][0][1])
    law = next(x for x in page.body if isinstance(x, ast.FunctionDef))
    scope = {"jnp": jax.numpy}
    exec(compile(ast.Module([law], []), "torque.md", "exec"), scope)
    slope = jax.jacfwd(scope[law.name], 2)
    assert slope(0.0, jax.numpy.ones(4), jax.numpy.zeros(3)).tolist() == [[0.0] * 3] * 3
    assert slope(0.0, jax.numpy.ones(4), jax.numpy.array([0.0, 0.0, 2.0]))[2, 2] == pytest.approx(-0.4, rel=1e-6)


def test_outputs_are_compared_by_their_words_and_rounded_numbers():
    assert words("energy 1.52 within 3e-15") == words("energy 1.5201 within 8e-16")
    assert words("energy 1.52") != words("energy 1.54")
    assert words("energy 1.52") != words("momentum 1.52")
    assert words("1e-15") != words("1e-6")


def commands():
    """The `lieint …` commands of the pages, of blocks and of the text; … stands for arguments left out."""
    for name, text in TEXTS.items():
        shell = [line for _, code in blocks(text, "sh") for line in code.replace("\\\n", " ").splitlines()]
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M)
        inline = [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
        for line in (*shell, *inline):
            if found := re.search(r"(?:^|\s)lieint (?=[a-z])(.*)", line.partition(" #")[0]):
                yield name, found[1].replace("…", "")


@pytest.mark.parametrize(("page", "command"), list(commands()))
def test_commands_in_pages_parse_and_name_existing_files(page, command):
    words = shlex.split(command)
    if "--help" in words or words in (["run"], ["check"], ["figure"], ["study"]):  # the name of a command alone
        with pytest.raises(SystemExit, match=r"^0$"):
            cli._parser().parse_args([words[0], "--help"])
        return
    options = cli._parser().parse_args(words)
    scenario = getattr(options, "scenario", "NAME")
    if getattr(options, "set", None) and scenario in scenarios.scenario_names():
        assert scenarios.load(scenario, options.set)
    assert scenario in (*scenarios.scenario_names(), "NAME", "SCENARIO") or scenario.endswith(".toml")


@pytest.mark.parametrize("name", [name for name, text in TEXTS.items() if blocks(text, "toml")])
def test_scenarios_in_pages_are_valid(name):
    import tomllib

    for _, code in blocks(TEXTS[name], "toml"):
        table = tomllib.loads(code)
        if "parts" in table:
            assert len(scenarios.validate(meshes.Parts, table, name).parts) > 1
        elif ".py:" not in table["system"]:  # whose kind another test runs
            assert scenarios.parse(table, name).members >= 1


def test_the_page_of_the_command_line_has_every_command_and_option():
    """They are made from the parser; the table at the top of the page is written by hand."""
    pytest.importorskip("mkdocs")
    hook = runpy.run_path(str(PAGES.parent / "hooks" / "scenario_keys.py"))
    page, rows = TEXTS["reference/command_line.md"], hook["options"]().splitlines()
    assert "<!-- lieint options -->" in page
    [commands] = [action for action in cli._parser()._actions if action.choices and not action.option_strings]
    for name, command in commands.choices.items():
        assert f"### `lieint {name}`" in rows
        assert f"| `lieint {name}" in page
        for action in command._actions:
            for option in action.option_strings:
                assert any(option in row.split("`")[1::2] or f"`{option} " in row for row in rows), option
    assert all(row.rstrip("| ").count("|") == 2 for row in rows if row.startswith("| `"))  # each has its help


def test_the_page_which_scheme_lists_every_scheme():
    """In its table of what schemes declare; and says when to use those of this package."""
    written, names = TEXTS["which_scheme.md"], [entry.name for entry in li.schemes.catalogue()]
    site = runpy.run_path(str(PAGES.parent / "hooks" / "catalogues.py"))["on_page_markdown"](written)
    assert [name for name in names if f"| `{name}` |" not in site] == []
    assert sum(f"`{name}" in written for name in names) >= 25
