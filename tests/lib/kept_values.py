"""Values that reports of the examples have printed since their first release: `tests/data/kept_values.toml`."""

import re

import data_files

KEPT = data_files.table("kept_values")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?(?!\w)|\bfails\b")
_ROUND_OFF = 1e-9  # a smaller number is one of rounding, which differs between processors


def numbers_after(words, text):
    """The numbers of the first line of a text that begins with these words and a number, as printed."""
    for line in text.splitlines():
        rest = re.match(rf"{re.escape(words)} (?=\(? ?[-+]?\d)(.*)", " ".join(line.split()))
        if rest:
            return _NUMBER.findall(rest[1])
    return []


def is_same(found, kept):
    """Whether two numbers differ by at most a millionth, or by one unit of the last digit of the one that was kept."""
    if found == kept or "fails" in (found, kept):
        return found == kept
    mantissa, _, exponent = kept.partition("e")
    last = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if max(abs(float(found)), abs(float(kept))) < _ROUND_OFF:
        return True
    return abs(float(found) - float(kept)) <= max(1e-6 * abs(float(kept)), 1.01 * last)


def assert_lines_are_kept(name, text):
    """Every line of an example that was kept has the same numbers in its report."""
    for words, values in KEPT.get(name, {}).get("lines", {}).items():
        found, wanted = numbers_after(words, text), values.split()
        assert len(found) == len(wanted), f"{words} {values}, in\n{text}"
        assert all(map(is_same, found, wanted)), f"{words}: {found}, kept as {values}, in\n{text}"
