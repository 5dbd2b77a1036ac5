"""The code blocks of Markdown documents."""

import re


def blocks(text, *languages):
    """(language, code) of each fenced block of a document in one of these languages, in order."""
    found = re.findall(r"^```(\w+)\n(.*?)^```$", text, re.S | re.M)
    return [(language, code) for language, code in found if language in languages]
