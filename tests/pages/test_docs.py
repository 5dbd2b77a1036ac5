"""The pages of the site are true: their Python runs and prints what they show, and their commands parse."""

import ast
import contextlib
import importlib.util
import inspect
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
from lieint_jax import examples
from lieint_jax.command import cli, scripts

PAGES = Path(__file__).parents[2] / "docs" / "pages"
TEXTS = {path.relative_to(PAGES).as_posix(): path.read_text(encoding="utf-8") for path in sorted(PAGES.rglob("*.md"))}
PYTHON = {name: blocks(text, "python", "text") for name, text in TEXTS.items() if blocks(text, "python")}
LONG = {  # expensive pages, which run in shards
    "faq.md",
    "install.md",
    "why.md",
    *(f"howto/{x}.md" for x in ("bodies", "chaos", "fits", "group", "output", "potential", "rates", "rods")),
    *(f"howto/{x}.md" for x in ("sampling", "satellite", "scheme", "shape", "system", "tides", "torque")),
    *(f"howto/{x}.md" for x in ("covariance", "equilibria", "fit_my_data", "kalman", "optimal_control")),
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


OWN = {
    "mine.py": ("reference/command_line.md", "complete one"),
    "/scripts/parts.py": ("howto/clusters.md", "`parts.py`"),
}


def own_script(name):
    """A script of `OWN`."""
    page, before = OWN[name]
    return blocks(TEXTS[page].partition(before)[2], "py")[0][1]


@pytest.mark.parametrize(("page", "command"), list(commands()))
def test_commands_in_pages_parse_and_name_existing_scripts(page, command, capsys):
    name, *options = shlex.split(command.partition(" > ")[0])
    if name != "run":
        assert cli._read([name, *options]) or "--help" in options
    elif options and options[0] not in ("NAME", "FILE.py"):  # which stand for a name
        scope = {"__name__": "page"}
        if options[0] in OWN:
            exec(compile(own_script(options[0]), options[0], "exec"), scope)
        script = scope["main"] if options[0] in OWN else scripts.example(options[0]).main
        assert cli._options(script, "lieint run", options[1:]) or "--help" in options


def test_the_script_of_the_page_of_the_command_line_runs_and_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(own_script("mine.py"), encoding="utf-8")
    assert cli.main(["run", "mine.py", "--members", "3", "--dt", "0.04"]) == 0
    report = capsys.readouterr().out
    assert "3 member(s), 1000 steps of 0.04 = 40" in report
    assert "3 of 3 members converged at every step" in report
    assert Path("bodies-errors.png").stat().st_size > 10_000
    assert float(abs(li.open("bodies.zarr").energy_error()).max()) < 1e-13


def test_the_page_of_the_command_line_has_every_command_and_argument():
    """They are made from the functions of the commands; the table at the top of the page is written by hand."""
    pytest.importorskip("mkdocs")
    hook = runpy.run_path(str(PAGES.parent / "hooks" / "commands.py"))
    page, rows = TEXTS["reference/command_line.md"], hook["options"]().splitlines()
    assert "<!-- lieint options -->" in page
    assert all(f"| `lieint {name}" in page for name in cli.COMMANDS)
    assert [row for row in rows if row.startswith("#")] == [
        f"### `lieint {name}`" for name in cli.COMMANDS if name != "run"
    ]
    named = [row.split("`")[1].split()[0] for row in rows if row.startswith("| `")]
    for name in cli.COMMANDS:
        for argument in inspect.signature(cli._function(name)).parameters if name != "run" else ():
            option = hook["OWN_NAMES"].get(argument, argument)
            assert f"--{option}" in named or argument.upper() in named, argument
    assert all(row.split("|")[2].strip() for row in rows if row.startswith("| `"))  # each has its help
    listed = hook["on_page_markdown"]("<!-- lieint list -->")
    assert [name for name in scripts.names() if f"| [`{name}`](../gallery/{name}.md) | " not in listed] == []


@pytest.fixture
def gallery(monkeypatch, tmp_path):
    """The hook that makes the gallery, with a cache and examples of its own."""
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("gallery", PAGES.parent / "hooks" / "gallery.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    monkeypatch.setattr(hook, "CACHE", tmp_path / "cache")
    return hook


def test_a_script_of_the_gallery_runs_once_until_it_or_the_package_changes(gallery, tmp_path, monkeypatch):
    runs = []

    def run(name, folder):
        runs.append(name)
        (folder / "a.png").write_bytes(b"picture")
        return f"the report of run {len(runs)}\npictures: a.png a.pdf\n"

    monkeypatch.setattr(gallery, "_run", run)
    first = gallery.results("pendulum")
    assert gallery.results("pendulum") == first
    assert (first / "picture.png").read_bytes() == b"picture"
    page = gallery._page("pendulum", first)
    assert "\nlieint run pendulum" in page
    assert "the report of run 1" in page
    assert Path(examples.__path__[0], "pendulum.py").read_text(encoding="utf-8").rstrip() in page
    monkeypatch.setattr(gallery, "SIZES", {"pendulum": "--members 2"})
    assert gallery.results("pendulum") != first
    assert runs == ["pendulum", "pendulum"]
    assert not first.exists()


def test_a_script_that_fails_fails_the_build_with_its_message(gallery, tmp_path, monkeypatch):
    from mkdocs.exceptions import PluginError

    monkeypatch.setattr(gallery, "SIZES", {"pendulum": "--members none"})
    with pytest.raises(PluginError, match=r"(?s)lieint_jax.examples.pendulum --members none failed:.*--members"):
        gallery.results("pendulum")
    assert not list((tmp_path / "cache").glob("*/*"))


def test_every_option_of_the_gallery_is_one_of_its_script(gallery):
    assert set(gallery.SIZES) <= set(scripts.names())
    for name, options in gallery.SIZES.items():
        assert cli._options(scripts.example(name).main, name, shlex.split(options))


def test_the_page_which_scheme_lists_every_scheme():
    """In its table of what schemes declare; and says when to use those of this package."""
    written, names = TEXTS["which_scheme.md"], [entry.name for entry in li.schemes.catalogue()]
    site = runpy.run_path(str(PAGES.parent / "hooks" / "catalogues.py"))["on_page_markdown"](written)
    assert [name for name in names if f"| `{name}` |" not in site] == []
    assert sum(f"`{name}" in written for name in names) >= 23
