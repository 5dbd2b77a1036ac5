"""float64 for every test but those that say otherwise, and a sample of the slow ones."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import jax
import pytest

jax.config.update("jax_enable_x64", True)
hypothesis.settings.register_profile("house", deadline=None, max_examples=25, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("house")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run every slow test, not the first of each function")
    parser.addoption("--long", action="store_true", help="run the long tests too")


def pytest_collection_modifyitems(config, items):
    seen = set()
    for item in items:
        if item.get_closest_marker("long") and not config.getoption("--long"):
            item.add_marker(pytest.mark.skip(reason="long: runs with --long"))
        elif item.get_closest_marker("slow") and not config.getoption("--slow"):
            function = (item.path, item.originalname)
            if function in seen:
                item.add_marker(pytest.mark.skip(reason="slow: the first of its function runs, all with --slow"))
            seen.add(function)
