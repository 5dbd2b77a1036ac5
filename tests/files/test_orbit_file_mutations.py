"""Files of orbits and attitudes that people damage or write differently: read right, or one sentence that says where.

A row: the file, what is replaced by what (None: the whole file), and the words of the error, or "" for read right.
"""

import contextlib

import data_files
import numpy as np
import pytest

from lieint_jax import files

OEM, AEM, TLE, OMM, HORIZONS, CSV = (
    data_files.text(f"samples/orbit.{kind}") for kind in ("oem", "aem", "tle", "omm", "horizons", "csv")
)
KEYS = [line.split(" = ") for line in OMM.splitlines() if line[:3] not in ("CCS", "COM")]
XML = f"<ndm><omm>{''.join(f'<{key}>{value}</{key}>' for key, value in KEYS)}</omm></ndm>"
JSON = "[{" + ", ".join(f'"{key}": "{value}"' for key, value in KEYS) + "}]"
COLUMNS = dict(time="t", positions=("x", "y", "z"), velocities=("vx", "vy", "vz"), unit_length="km", epoch="2024-03-01")
READERS = {
    "OEM": (OEM, files.read_oem),
    "AEM": (AEM, files.read_aem),
    "TLE": (TLE, files.read_tle),
    "OMM": (OMM, files.read_omm),
    "XML": (XML, files.read_omm),
    "JSON": (JSON, files.read_omm),
    "HORIZONS": (HORIZONS, files.read_horizons),
    "CSV": (CSV, lambda path: files.read_ephemeris_csv(path, **COLUMNS)),
}
SECOND = OEM.split("META_START")[1]
LAST = "2024-03-01T00:02:00.000 6941.5034 903.0017 0.0 -0.973444 7.482999 0.0\n"
EMPTY = r"the file is cut short, or no {}: it ends before META_START"
CASES = [  # and those that have a whole sample or thousands of characters
    *data_files.table("orbit_file_mutations")["rows"],
    ["OEM", OEM, "", EMPTY.format("OEM")],
    ["OEM", OEM, "\0" * 99, r"is no text: it has a null character"],
    ["OEM", OEM, XML, r"line 1: the message must begin with CCSDS_OEM_VERS = .*, as text and not XML"],
    ["OEM", "2024-03-01T00:01:00.000", "9" * 5000, r"line 16: a date must be as in"],
    ["OEM", LAST, f"{LAST}META_START{SECOND}", r"line 18: segments 0 and 1 of 0 to 1 leave a gap in time or overlap"],
    ["OEM", LAST, f"{LAST}META_START{SECOND.replace('EME2000', 'ICRF')}", r"differ in REF_FRAME: choose one by"],
    ["OEM", LAST, f"{LAST}META_START{SECOND.replace('UTC', 'TAI')}", r"differ in TIME_SYSTEM: choose one by segment=1"],
    ["AEM", AEM, "", EMPTY.format("AEM")],
    ["XML", "<omm>", "<omm>" + "<a>" * 10**5, r"the XML cannot be read|the message must have"],
    ["JSON", JSON, "[" * 10**5, r"the JSON cannot be read, or is cut short"],
]


def numbers(found):
    """What was read as numbers."""
    if isinstance(found, files.MeanElements):
        return [*found.elements[:7], found.catalog_number, found.epoch.julian_date]
    values = found.attitudes if isinstance(found, files.Attitudes) else np.hstack([found.positions, found.velocities])
    return [*np.ravel(found.times), *np.ravel(values), found.epoch.julian_date]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("kind", "old", "new", "words"), CASES, ids=range(len(CASES)))
def test_a_file_is_read_right_or_refused_in_a_sentence(kind, old, new, words, tmp_path):
    text, read = READERS[kind]
    assert old in text
    path = tmp_path / "file"
    path.write_bytes(text.replace(old, new).encode())
    if words:
        with pytest.raises((ValueError, UserWarning), match=words) as caught:
            read(path)
        message = str(caught.value)
        assert message.startswith(str(path))
        assert len(message) < 600
        assert "\n" not in message
        assert message.isprintable()
    else:
        plain = tmp_path / "plain"
        plain.write_text(text)
        np.testing.assert_allclose(numbers(read(path)), numbers(read(plain)), rtol=0, atol=5e-5)


def test_any_cut_of_a_file_is_read_or_refused_in_a_sentence(tmp_path):
    """At every character: no other exception, and no warning of any kind but those of the readers."""
    path = tmp_path / "file"
    for text, read in READERS.values():
        for k in range(0, len(text), 11):
            path.write_text(text[:k])
            with contextlib.suppress(UserWarning):
                try:
                    read(path)
                except ValueError as error:
                    message = str(error)
                    assert message.startswith(str(path))


@pytest.mark.parametrize("kind", ["OEM", "AEM", "TLE", "OMM", "Horizons"])
def test_a_file_is_identified_whatever_its_encoding_and_line_ends(kind, tmp_path):
    text, path = READERS[kind.upper()][0], tmp_path / "file"
    for changed in (text, text.replace("\n", "\r\n"), text.replace("\n", " \t  \n"), "\n" + text):
        for encoding in ("utf-8", "utf-8-sig", "utf-16"):
            path.write_bytes(changed.encode(encoding))
            assert files.identify(path) == kind
