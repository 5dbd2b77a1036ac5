"""Long names in tables break after a slash or an underscore, not within a word."""

import re

LONG = re.compile(r"(?<=<code>)[^<>]{18,}(?=</code>)")
CELL = re.compile(r"<td\b.*?</td>", re.S)
BREAK = re.compile(r"(?<=/)|(?<=[a-z0-9]_)(?=\w)|(?<=::)")


def on_page_content(content, **_):
    """Add places for line breaks to the code in tables."""
    return CELL.sub(lambda cell: LONG.sub(lambda code: BREAK.sub("<wbr>", code[0]), cell[0]), content)
