"""Files of orbits and attitudes that people damage or write differently: read right, or one sentence that says where.

A row: the file, what is replaced by what (None: the whole file), and the words of the error, or "" for read right.
"""

import contextlib

import numpy as np
import pytest

from lieint_jax import files

HEAD = "CREATION_DATE = 2024-01-01T00:00:00\nORIGINATOR = X\n"
META = "META_START\nOBJECT_NAME = SAT\nOBJECT_ID = 2024-001A\nCENTER_NAME = EARTH\n"
TIMES = "TIME_SYSTEM = UTC\nSTART_TIME = 2024-03-01T00:00:00\nSTOP_TIME = 2024-03-01T00:02:00\n"
OEM = f"""CCSDS_OEM_VERS = 2.0
{HEAD}
{META}REF_FRAME = EME2000
{TIMES}META_STOP
COMMENT a circle
2024-03-01T00:00:00.000 7000.0 0.0 0.0 0.0 7.546049 0.0
2024-03-01T00:01:00.000 6985.3600 452.4471 0.0 -0.487742 7.530270 0.0
2024-03-01T00:02:00.000 6941.5034 903.0017 0.0 -0.973444 7.482999 0.0
"""
AEM = f"""CCSDS_AEM_VERS = 1.0
{HEAD}
{META}REF_FRAME_A = EME2000
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
{TIMES}ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP
DATA_START
2024-03-01T00:00:00 0.6 0.0 0.0 0.8
2024-03-01T00:01:00 0.0 0.6 0.0 0.8
2024-03-01T00:02:00 0.0 0.0 0.6 0.8
DATA_STOP
"""
TLE = """ISS (ZARYA)
1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927
2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537
"""
OMM = """CCSDS_OMM_VERS = 2.0
COMMENT GENERATED
OBJECT_NAME = ISS
CENTER_NAME = EARTH
REF_FRAME = TEME
TIME_SYSTEM = UTC
MEAN_ELEMENT_THEORY = SGP/SGP4
EPOCH = 2008-09-20T12:25:40.104192
MEAN_MOTION = 15.72125391
ECCENTRICITY = 0.0006703
INCLINATION = 51.6416
RA_OF_ASC_NODE = 247.4627
ARG_OF_PERICENTER = 130.536
MEAN_ANOMALY = 325.0288
NORAD_CAT_ID = 25544
BSTAR = -1.1606e-5
"""
KEYS = [line.split(" = ") for line in OMM.splitlines() if line[:3] not in ("CCS", "COM")]
XML = f"<ndm><omm>{''.join(f'<{key}>{value}</{key}>' for key, value in KEYS)}</omm></ndm>"
JSON = "[{" + ", ".join(f'"{key}": "{value}"' for key, value in KEYS) + "}]"
HORIZONS = """Target body name: SAT (-1)                     {source: x}
Center body name: Earth (399)                  {source: x}
Start time      : A.D. 2024-Mar-01 00:00:00.0000 TDB
Output units    : KM-S
Output type     : GEOMETRIC cartesian states
Reference frame : ICRF
$$SOE
2460370.500000000 = A.D. 2024-Mar-01 00:00:00.0000 TDB
 X = 7.000000000000000E+03 Y = 0.0 Z = 0.0
 VX= 0.0 VY= 7.546049 VZ= 0.0
2460370.500694444 = A.D. 2024-Mar-01 00:01:00.0000 TDB
 X = 6.9853600E+03 Y = 452.4471 Z = 0.0
 VX=-0.487742 VY= 7.530270 VZ= 0.0
$$EOE
"""
CSV = """t,x,y,z,vx,vy,vz
0,7000.0,0,0,0,7.546049,0
60,6985.3600,452.4471,0,-0.487742,7.530270,0
120,6941.5034,903.0017,0,-0.973444,7.482999,0
"""
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
FIRST = "2024-03-01T00:01:00.000 6985.3600 452.4471 0.0 -0.487742 7.530270 0.0\n"
LAST = "2024-03-01T00:02:00.000 6941.5034 903.0017 0.0 -0.973444 7.482999 0.0\n"
COVARIANCE = "COVARIANCE_START\nEPOCH = 2024-03-01T00:00:00\n1.0\n0.1 1.0\nCOVARIANCE_STOP\n"
EMPTY = r"the file is cut short, or no {}: it ends before META_START"
NO_NUMBER = r"must be a finite number, got "
CASES = [
    ("OEM", "\n", "\r\n", ""),
    ("OEM", "\n", "\r", ""),
    ("OEM", "CCSDS_OEM", "\ufeffCCSDS_OEM", ""),
    ("OEM", " = ", "=", ""),
    ("OEM", " = ", "\t=   ", ""),
    ("OEM", "2.0\n", "3.0\n", ""),
    ("OEM", "7000.0 0.0", "7.0D+03\t0.0", ""),
    ("OEM", "7000.0 0.0", "7.0d3     0", ""),
    ("OEM", "COMMENT a circle\n", "\n\nCOMMENT\n  COMMENT = 1\n", ""),
    ("OEM", "2024-03-01T00:01:00.000", "2024-061T00:01:00", ""),
    ("OEM", "2024-03-01T00:01:00.000", "2024-03-01T00:01:00.000Z", ""),
    ("OEM", LAST, LAST + COVARIANCE, ""),
    ("OEM", " 0.0\n", " 0.0 0.001 0.001 0.001\n", ""),
    ("OEM", "TIME_SYSTEM = UTC\n", "TIME_SYSTEM = UTC\nINTERPOLATION = LAGRANGE\nSOMETHING = 1\n", ""),
    ("OEM", "7000.0 0.0", "NaN 0.0", r"line 15: an entry must be a finite number, got 'NaN'"),
    ("OEM", "7000.0 0.0", "1e999 0.0", r"line 15: an entry must be a finite number, got '1e999'"),
    ("OEM", "7000.0 0.0", "7000,0 0.0", r"line 15: an entry must be a finite number, got '7000,0'"),
    ("OEM", "7000.0 0.0", "\x1b[2J 0.0", r"line 15: an entry must be a finite number, got '\\\\x1b\[2J'"),
    ("OEM", "7000.0 0.0", "7000.0", r"line 15: a row must be an epoch and 6 or 9 numbers, got 5"),
    ("OEM", FIRST + LAST, LAST + FIRST, r"line 17: times must increase, got 2024-03-01T00:01:00 .* of line 16"),
    ("OEM", FIRST, FIRST * 2, r"line 17: times must increase, got 2024-03-01T00:01:00 UTC after .* of line 16"),
    ("OEM", FIRST + LAST, "", "line 12: the rows miss 120 s at STOP_TIME: the file may be cut short"),
    ("OEM", OEM[OEM.index("2024-03-01T00:00:00.000") :], "", r"line 5: the segment that begins here has no rows"),
    ("OEM", OEM[OEM.index("START_TIME") :], "", r"line 11: the file is cut short.* before META_STOP"),
    ("OEM", OEM[OEM.index("META_START") :], "", EMPTY.format("OEM")),
    ("OEM", "7.482999 0.0\n", "7.48", r"line 17: a row must be an epoch and 6 or 9 numbers, got 5"),
    ("OEM", OEM, "", EMPTY.format("OEM")),
    ("OEM", OEM, "\0" * 99, r"is no text: it has a null character"),
    ("OEM", LAST, LAST + COVARIANCE[:60], r"cut short.* before COVARIANCE_STOP"),
    ("OEM", "REF_FRAME = EME2000\n", "", r"line 5: the metadata that begin here must have REF_FRAME"),
    ("OEM", "TIME_SYSTEM = UTC\n", "", r"line 5: the metadata that begin here must have TIME_SYSTEM"),
    ("OEM", "TIME_SYSTEM = UTC", "TIME_SYSTEM = MRT", r"line 10: TIME_SYSTEM must be one of UTC, .* got 'MRT'"),
    ("OEM", "CENTER_NAME = EARTH", "CENTER_NAME = A\nCENTER_NAME = B", r"line 9: CENTER_NAME is given twice"),
    ("OEM", "CCSDS_OEM_VERS", "CIC_OEM_VERS", r"line 1: the message must begin with CCSDS_OEM_VERS = 1.0, 2.0 or 3.0"),
    ("OEM", "CCSDS_OEM_VERS", "CCSDS_AEM_VERS", r"line 1: the message must begin with CCSDS_OEM_VERS"),
    ("OEM", "VERS = 2.0", "VERS = 9.0", r"line 1: the message must begin with CCSDS_OEM_VERS = 1.0, 2.0 or 3.0"),
    ("OEM", OEM, XML, r"line 1: the message must begin with CCSDS_OEM_VERS = .*, as text and not XML"),
    ("OEM", "COMMENT a circle", "a circle = 1", r"line 14: a row of data or KEY = value of metadata was expected"),
    ("OEM", "CENTER_NAME = EARTH", "CENTER_NAME EARTH", r"line 8: a row of data or KEY = value of metadata"),
    ("OEM", "COMMENT a circle", "META_STOP", r"line 14: META_STOP must not stand outside"),
    ("OEM", "CENTER_NAME", "META_START\nCENTER_NAME", r"line 8: META_START must not stand before META_STOP"),
    ("OEM", "2024-03-01T00:01:00.000", "2024-02-30T00:01:00", r"line 16: the date '2024-02-30T00:01:00' does not"),
    ("OEM", "2024-03-01T00:01:00.000", "2024-366", r"line 17: times must increase"),
    ("OEM", "2024-03-01T00:01:00.000", "2023-366T00:00", r"line 16: the date '2023-366T00:00' does not exist"),
    ("OEM", "2024-03-01T00:01:00.000", "2024-03-01T00:00:60", r"line 16: .* is in a leap second"),
    ("OEM", "2024-03-01T00:01:00.000", "01.03.2024", r"line 16: a date must be as in"),
    ("OEM", "2024-03-01T00:01:00.000", "9" * 5000, r"line 16: a date must be as in"),
    ("OEM", " 7.", " 7000.", r"positions and velocities disagree: from t = .* the same unit of length"),
    ("OEM", LAST, f"{LAST}META_START{SECOND}", r"line 18: segments 0 and 1 of 0 to 1 leave a gap in time or overlap"),
    ("OEM", LAST, f"{LAST}META_START{SECOND.replace('EME2000', 'ICRF')}", r"differ in REF_FRAME: choose one by"),
    ("OEM", LAST, f"{LAST}META_START{SECOND.replace('UTC', 'TAI')}", r"differ in TIME_SYSTEM: choose one by segment=1"),
    ("AEM", "\n", "\r\n", ""),
    ("AEM", "DATA_START\n", "", r"line 21: DATA_STOP must not stand outside of a block"),
    ("AEM", "DATA_STOP\n", "", r"cut short.* before DATA_STOP"),
    ("AEM", "0.6 0.0 0.0 0.8", "0.60002 0.0 0.0 0.79998", ""),
    ("AEM", "0.6 0.0 0.0 0.8", "0.601 0.0 0.0 0.8", r"line 19: a quaternion must have norm 1 up to 0.0001, got 1.0006"),
    ("AEM", "0.6 0.0 0.0 0.8", "0 0 0 0", r"line 19: a quaternion must have norm 1"),
    ("AEM", "0.6 0.0 0.0 0.8", "0.6 0.0 0.8", r"line 19: a row must be an epoch and 4 numbers, got 3"),
    ("AEM", "0.6 0.0 0.0 0.8", "0.6 0.0 0.0 inf", rf"line 19: an entry {NO_NUMBER}'inf'"),
    ("AEM", "0.0 0.6 0.0 0.8", "0.0 -0.6 0.0 -0.8", ""),
    ("AEM", "QUATERNION_TYPE = LAST\n", "", r"line 5: the metadata that begin here must have QUATERNION_TYPE"),
    ("AEM", "= LAST", "= MIDDLE", r"line 16: QUATERNION_TYPE must be FIRST or LAST, got 'MIDDLE'"),
    ("AEM", "ATTITUDE_DIR = A2B\n", "", r"line 5: the metadata that begin here must have ATTITUDE_DIR"),
    ("AEM", "= A2B", "= B2C", r"line 11: ATTITUDE_DIR must be A2B or B2A, got 'B2C'"),
    ("AEM", "= QUATERNION\n", "= SPIN\n", r"line 15: ATTITUDE_TYPE must be one of QUATERNION, .* got 'SPIN'"),
    ("AEM", "= QUATERNION\n", "= EULER_ANGLE\nEULER_ROT_SEQ = 321\n", r"a row must be an epoch and 3 numbers, got 4"),
    ("AEM", "REF_FRAME_B", "REF_FRAME", r"line 5: the metadata that begin here must have REF_FRAME_B"),
    ("AEM", "VERS = 1.0", "VERS = 2.0", ""),
    ("AEM", AEM, "", EMPTY.format("AEM")),
    ("TLE", "\n", "\r\n", ""),
    ("TLE", "\n", "\n\n", ""),
    ("TLE", "ISS", "0 ISS", ""),
    ("TLE", "2927\n", "2927   \n", ""),
    ("TLE", "2927", "2926", r"line 2: the checksum must be 7, got '6'"),
    ("TLE", "51.6416", "51.6417", r"line 3: the checksum must be 8, got '7'"),
    ("TLE", "391563537", "39", r"line 3: line 2 of a TLE must begin with 2 and have 69 characters, it has 62"),
    ("TLE", TLE[TLE.index("2 25544") :], "", r"the second line of the elements is missing: the file is cut short"),
    ("TLE", "2 25544", "2 25553", r"line 3: both lines must be of one satellite, got 25544 and 25553"),
    ("TLE", "25544", "I5544", r"line 2: the checksum"),
    ("TLE", "0006703", "00x6703", r"line 3: the eccentricity must be seven digits, got '00x6703'"),
    ("TLE", "08264.5", "08764.5", r"line 2: the checksum"),
    ("TLE", "08264.5", "08714.5", r"line 2: the date '2008-714' does not exist"),
    ("TLE", "15.72125391", "-5.72125391", r"line 3: the mean motion must be 0 to 20"),
    ("TLE", "-11606-4", "-11606*4", r"line 2: the checksum"),
    ("TLE", TLE, "nothing\n", r"elements of one satellite are needed, got 0"),
    ("TLE", TLE, TLE * 2, r"of one satellite are needed, got 2: give satellite=, one of: ISS \(ZARYA\) \(25"),
    ("OMM", "\n", "\r\n", ""),
    ("OMM", "15.72125391", "15.72125391 [rev/day]", ""),
    ("OMM", "MEAN_MOTION", "SEMI_MAJOR_AXIS", r"the message must have MEAN_MOTION"),
    ("OMM", "SGP/SGP4", "SGP4-XP", r"line 7: MEAN_ELEMENT_THEORY must be SGP4, as SGP4 needs, got 'SGP4-XP'"),
    ("OMM", "TEME", "TOD", r"line 5: REF_FRAME must be TEME"),
    ("OMM", "0.0006703", "1.5", r"the eccentricity 0 to 1"),
    ("OMM", "0.0006703", "nan", rf"line 10: ECCENTRICITY {NO_NUMBER}'nan'"),
    ("OMM", "EPOCH = ", "EPOCHE = ", r"the message must have EPOCH"),
    ("OMM", OMM, "", r"there is no orbit mean elements message \(OMM\)"),
    ("XML", "<ndm>", "<?xml version='1.0'?><ndm xmlns='urn:x'>", ""),
    ("XML", "</omm></ndm>", "", r"line 1: the XML cannot be read, or is cut short"),
    ("XML", "<ndm>", "<!DOCTYPE a [<!ENTITY b 'c'>]><ndm>", r"the XML must have no DOCTYPE"),
    ("XML", "<omm>", "<omm>" + "<a>" * 10**5, r"the XML cannot be read|the message must have"),
    ("JSON", '"15.72125391"', "15.72125391", ""),
    ("JSON", '"15.72125391"', "NaN", rf"MEAN_MOTION {NO_NUMBER}'NaN'"),
    ("JSON", '"15.72125391"', '{"a": 1}', rf"MEAN_MOTION {NO_NUMBER}"),
    ("JSON", "}]", "", r"line 1: the JSON cannot be read, or is cut short"),
    ("JSON", JSON, "[" * 10**5, r"the JSON cannot be read, or is cut short"),
    ("JSON", JSON, "[1, 2]", r"the JSON must be a list of objects"),
    ("HORIZONS", "\n", "\r\n", ""),
    ("HORIZONS", "VX= 0.0", "VX= 0.0D+00", ""),
    ("HORIZONS", "00:00:00.0000", "00:00", ""),
    ("HORIZONS", "VZ= 0.0\n", "VZ= 0.0\n LT= 1.0 RG= 2.0 RR= 3.0\n", ""),
    ("HORIZONS", "$$EOE\n", "", r"the line \$\$EOE is missing: it is no table of Horizons, or is cut short"),
    ("HORIZONS", "KM-S", "AU-Y", r"line 4: the units must be KM-S, KM-D or AU-D, got 'AU-Y'"),
    ("HORIZONS", "GEOMETRIC", "LT+S", r"line 5: the states must be geometric"),
    ("HORIZONS", "0000 TDB\nOutput", "0000 X\nOutput", r"line 3: the scale of the times"),
    ("HORIZONS", " VX= 0.0 VY= 7.546049 VZ= 0.0\n", "", r"line 8: an entry must be a position and a velocity .* got 3"),
    ("HORIZONS", "2460370.500694444", "2460371.5", r"line 11: the date must be of the Gregorian calendar and agree"),
    ("HORIZONS", "Reference frame : ICRF\n", "", r"the header of the table must have a line Reference frame"),
    ("HORIZONS", "Target", "Target of", r"must have a line Target body name"),
    ("HORIZONS", "00:01:00.0000", "00:00:00.0000", r"line 11: times must increase"),
    ("HORIZONS", "Y = 0.0", "Y = n.a.", rf"line 9: an entry {NO_NUMBER}'n.a.'"),
    ("CSV", "\n", "\r\n", ""),
    ("CSV", ",", " ;\t", ""),
    ("CSV", ",", "\t", ""),
    ("CSV", "t,x", "\ufefft,x", ""),
    ("CSV", "t,x", '# km\n\n"t","x"', ""),
    ("CSV", "t,x", "t,X", r"line 1: there is no column 'x'; the columns are \['t', 'X'"),
    ("CSV", "60,", "60,,", r"line 3: a row must have 7 columns, got 8"),
    ("CSV", "7.546049", "", rf"line 2: an entry {NO_NUMBER}''"),
    ("CSV", "60,", "0,", r"line 3: times must increase, got 0 after 0 of line 2"),
    ("CSV", CSV, "", r"the file has no line of the names of its columns"),
    ("CSV", CSV[CSV.index("60,") :], "", r"an orbit needs at least two entries, there is one"),
    ("CSV", ",7.", ",7000.", r"positions and velocities disagree: from t = .* the same unit of length"),
]  # fmt: skip


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
