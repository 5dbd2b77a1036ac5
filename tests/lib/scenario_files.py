"""Files of scenarios for tests of the command line: that of a free body, and any with other lines."""

import re
from pathlib import Path

import data_files


def book(**lines):
    """The text of the file, with these lines in place of those of the keys: book(members="members = 3")."""
    text = data_files.text("scenarios/book.toml")
    for key, line in lines.items():
        text, found = re.subn(rf"(?m)^{key} = .*$", lambda _, line=line: line, text)
        assert found == 1, key
    return text


def written(name, text, *changes):
    """The name of a file with this text, in which each (old, new) is replaced."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    Path(name).write_text(text, encoding="utf-8")
    return name
