"""What a file of people is, by its contents."""

from __future__ import annotations

import re
from pathlib import Path

from lieint_jax import shapes
from lieint_jax._text import read_bytes

_HEAD = 2**20  # bytes at the beginning that are looked at
_MARKS = {  # what only files of a format have; the first that is found decides
    "OEM": r"^\s*CCSDS_OEM_VERS\s*=",
    "AEM": r"^\s*CCSDS_AEM_VERS\s*=",
    "OMM": r"^\s*CCSDS_OMM_VERS\s*=|<omm\b|\"MEAN_MOTION\"",
    "Horizons": r"^\$\$SOE",
    "TLE": r"^1 [ 0-9A-Z]{5}[A-Z ].{55,61}[ \t]*\n2 [ 0-9A-Z]{5} ",
    "URDF": r"<robot\b",
    "MJCF": r"<mujoco\b",
    "light curves": r"^STARTMETADATA|\"LightCurve\"|\A\s*\d+\s*\n\s*\d+\s+[01]\s*\n(?:[ \t]*[-+.\dEeDd]+){8}[ \t]*$",
    "PDB": r"^(?:ATOM  |HETATM)[ \d*]",
    "xyz": r"\A\s*\d+[ \t]*\n.*\n[ \t]*[A-Za-z]{1,3}\d*(?:[ \t]+[-+.\dEe]+){3}",
}
_TABLE = re.compile(r"(?=.*[A-Za-z_]).*[,;\t ]")  # the first row of a table with names of columns


def identify(path: str | Path) -> str:
    """The format of a file that this room reads, by its contents, and of shapes by its ending.

    Returns:
        "OEM", "AEM", "TLE", "OMM", "Horizons", "shape", "URDF", "MJCF", "PDB", "xyz", "light curves", "table" (of text
        with names of columns), or "" for any other file.

    Raises:
        ValueError: there is no such file.

    Example:
        >>> identify("nothing.oem")
        Traceback (most recent call last):
        ValueError: there is no file nothing.oem
    """
    head, name = read_bytes(path, _HEAD), str(path).lower().removesuffix(".gz")
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = re.sub(r"\r\n?", "\n", head.decode(encoding, "replace"))
    text = "" if "\0" in text else text
    for form, mark in _MARKS.items():
        if re.search(mark, text, re.MULTILINE):
            return form
    if name.endswith(shapes.ENDINGS):
        return "shape"
    rows = [line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")]
    named = len(rows) > 1 and _TABLE.match(rows[0]) and not name.endswith(".toml")
    return "table" if named else ""
