"""The command as it is installed, before it is imported."""

import sys
import tomllib
from pathlib import Path

import lieint_command
from lieint_jax.app.command import cli

ROOT = Path(__file__).parents[2]


def test_an_interrupt_while_jax_is_imported_is_one_line(monkeypatch, capsys):
    """The module of the command cannot be imported before JAX is; the installed command is another one."""

    class Interrupted:
        @staticmethod
        def find_spec(name, *_):
            if name == "lieint_jax.app.command":
                raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        for name in ("lieint_jax.app.command", "lieint_jax.app.command.cli"):
            patch.delitem(sys.modules, name)
        patch.setattr(sys, "meta_path", [Interrupted, *sys.meta_path])
        assert lieint_command.main() == 130
    assert capsys.readouterr().err == "lieint: interrupted\n"
    monkeypatch.setattr(cli, "main", lambda: 7)
    assert lieint_command.main() == 7


def test_the_entry_is_the_same_for_pip_and_conda():
    [entry] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"].items()
    assert entry == ("lieint", "lieint_command:main")
    assert "- {} = {}\n".format(*entry) in (ROOT / "docs/conda/recipe.yaml").read_text(encoding="utf-8")
