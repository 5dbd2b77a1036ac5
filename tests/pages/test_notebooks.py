"""Every notebook runs from top to bottom; its own asserts are its tests."""

from importlib.util import find_spec
from pathlib import Path

import nbclient
import nbformat
import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
EXTRA = {"10_learned_potential": ["diffrax"], "11_posterior": ["arviz", "blackjax"]}  # of the extra `notebooks`


@pytest.mark.long
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda p: p.stem)
def test_every_notebook_runs_without_an_error(path):
    for package in EXTRA.get(path.stem, []):
        if find_spec(package) is None:
            pytest.skip(f"needs {package}")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": FOLDER}}
    ).execute()
