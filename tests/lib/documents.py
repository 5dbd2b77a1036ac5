"""The code blocks of Markdown documents, and the words of what they print."""

import re

ROUND_OFF = 1e-11  # numbers below this are rounding errors, whose digits differ from machine to machine


def blocks(text, *languages):
    """(language, code) of each fenced block of a document in one of these languages, in order."""
    found = re.findall(r"^```(\w+)\n(.*?)^```$", text, re.S | re.M)
    return [(language, code) for language, code in found if language in languages]


class Word(str):
    """A word of printed text; numbers are equal to within a thousandth, and all rounding errors are equal."""

    __hash__ = str.__hash__

    def __eq__(self, other):
        try:
            a, b = float(self), float(other)
        except ValueError:
            return str(self) == str(other)
        return abs(a - b) <= 1e-3 * abs(b) or max(abs(a), abs(b)) < ROUND_OFF


def words(text):
    """The words of a text; how many digits a certificate counts, or whether all, depends on rounding: left out."""
    text = re.sub(r"reversible (bit for bit|to round-off, [\d.]+ digits)", "reversible", text)
    text = re.sub(r"[\d.]+ digits", "digits", text)
    return [Word(word) for word in re.findall(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?|[^\s\d]+", text)]
