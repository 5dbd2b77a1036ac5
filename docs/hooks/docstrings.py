"""A Griffe extension: docstrings as its parser wants them.

`Example:` becomes the section `Examples:`, `a, b: text` of arguments or attributes becomes a line for each name, a
description that begins with > is no quotation, and shapes such as (times, [members,] [bodies,] 3) are no links.
"""

import re

from griffe import Extension

EXAMPLE = re.compile(r"^Example:(?: (.+(?:\n(?! |$).+)*))?\n(?=(?:\n| {4}).*>>>)", re.M)
SEVERAL = re.compile(r"^    (\w+(?:, \w+)+)(: .*(?:\n {8}.*)*)$", re.M)

GREATER = re.compile(r"^(    \w+: )(?=>)", re.M)
OPTIONAL = re.compile(r"(?<=,\] )\[(?=\w+,\])")


class Docstrings(Extension):
    """Rewrite every docstring."""

    def on_instance(self, *, obj, **_):
        """Called for each module, class, function and attribute."""
        if obj.docstring:
            text = EXAMPLE.sub(_examples, obj.docstring.value)
            text = OPTIONAL.sub(r"\\[", text)
            obj.docstring.value = GREATER.sub(r"\1\\", SEVERAL.sub(_each, text))


def _examples(found):
    return f"Examples:\n    {found[1]}\n" if found[1] else "Examples:\n"


def _each(found):
    names, text = found.groups()
    return "\n".join(f"    {name}{text}" for name in names.split(", "))
