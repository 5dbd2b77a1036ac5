"""The command as it is installed, before it is imported."""

import sys
import tomllib
from pathlib import Path

from lieint_jax.command import cli, entry

ROOT = Path(__file__).parents[2]


def test_an_interrupt_while_jax_is_imported_is_one_line(monkeypatch, capsys):
    """The module of the command cannot be imported before JAX is; the installed command is another one."""

    class Interrupted:
        @staticmethod
        def find_spec(name, *_):
            if name == "lieint_jax.command":
                raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        for name in ("lieint_jax.command", "lieint_jax.command.cli"):
            patch.delitem(sys.modules, name)
        patch.setattr(sys, "meta_path", [Interrupted, *sys.meta_path])
        assert entry.main() == 130
    assert capsys.readouterr().err == "lieint: interrupted\n"
    monkeypatch.setattr(cli, "main", lambda: 7)
    assert entry.main() == 7


def test_the_entry_is_the_same_for_pip_and_conda():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    [script] = project["project"]["scripts"].items()
    assert script == ("lieint", "lieint_command:main")
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {Path(entry.__file__).relative_to(ROOT).as_posix(): "lieint_command.py"}
    assert "- {} = {}\n".format(*script) in (ROOT / "docs/conda/recipe.yaml").read_text(encoding="utf-8")
