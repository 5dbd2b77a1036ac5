"""The list of `mutate.py` fits the package: each change can be made, and its tests are among those of README."""

import ast
import functools
import re

import pytest
from mutate import ROOT, mutations, part


@functools.cache
def functions(file):
    """The test functions of a file, and whether each is marked `long` as a whole, or with its file and not `quick`."""
    text = (ROOT / file).read_text(encoding="utf-8")
    tree, all_long = ast.parse(text), re.search(r"^pytestmark = .*pytest\.mark\.long", text, re.M)
    marks = {
        node.name: {ast.unparse(mark) for mark in node.decorator_list}
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }
    return {
        name: "pytest.mark.long" in own or ("pytest.mark.quick" not in own and bool(all_long))
        for name, own in marks.items()
    }


def test_every_change_can_be_made_and_has_tests_that_readme_s_command_runs():
    entries = mutations()
    assert len(entries) >= 60
    assert len({entry.name for entry in entries}) == len(entries)
    for entry in entries:
        assert entry.old != entry.new
        ast.parse(entry.source())
        assert entry.tests, entry.name
        for test in entry.tests:
            file, _, name = test.partition("::")
            assert name in functions(file), test
            assert not functions(file)[name], f"{test} is marked long"


def test_shards_share_out_all_changes():
    entries = mutations()
    parts = [part(entries, f"{k}/7", "") for k in range(1, 8)]
    assert sorted(entry.name for some in parts for entry in some) == sorted(entry.name for entry in entries)
    with pytest.raises(SystemExit, match="--shard takes K/N"):
        part(entries, "8/7", "")
