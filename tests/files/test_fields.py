"""Fields of files that change the meaning of others, by format: each is read, so that the values follow, or refused.

A row: the sample, the field, what is replaced by what, and a pattern of the error or a check of what is read.
"""

import warnings

import data_files
import numpy as np
import pytest

from lieint_jax import files, shapes

OEM, AEM, TLE, OMM, HORIZONS, CSV = (
    data_files.text(f"samples/orbit.{kind}") for kind in ("oem", "aem", "tle", "omm", "horizons", "csv")
)
KEYS = [line.split(" = ") for line in OMM.splitlines() if line[:3] not in ("CCS", "COM")]
UNITS = {"MEAN_MOTION": "rev/day", "INCLINATION": "deg", "BSTAR": "1/ER"}
XML = "".join(f'<{key} units="{UNITS[key]}">{x}</{key}>' if key in UNITS else f"<{key}>{x}</{key}>" for key, x in KEYS)
BODIES = {
    name: data_files.text(f"samples/bodies/{name}") for name in ("a.obj", "a.urdf", "a.xml", "alcdef.txt", "lc.txt")
}
SPEED = "t [s],x [km],y,z,vx (km/s),vy,vz\n" + CSV.partition("\n")[2]
PLACES = dict(positions=("x [km]", "y", "z"), velocities=("vx (km/s)", "vy", "vz"), unit_length="km")
GYRO = "time [s],wx [rad/s],wy (body),wz\n0,0.1,0.2,0.3\n1,0.4,0.5,0.6\n"


def by_name(text, path, **options):
    """The table of a text whose names of columns may be changed: they are asked for as they are."""
    t, x, y, z, vx, vy, vz = text.partition("\n")[0].split(",")
    return files.read_ephemeris_csv(
        path, **PLACES | dict(time=t, positions=(x, y, z), velocities=(vx, vy, vz), epoch="2024-03-01") | options
    )


def log(text, path, **options):
    t, *rates = text.partition("\n")[0].split(",")
    return files.read_csv_log(path, time=t, rates=rates, **options)


READERS = {
    "OEM": (OEM, lambda text, path: files.read_oem(path)),
    "AEM": (AEM, lambda text, path: files.read_aem(path)),
    "TLE": (TLE, lambda text, path: files.read_tle(path)),
    "OMM": (OMM, lambda text, path: files.read_omm(path)),
    "XML": (f"<ndm><omm>{XML}</omm></ndm>", lambda text, path: files.read_omm(path)),
    "JSON": (
        "[{" + ", ".join(f'"{key}": "{value}"' for key, value in KEYS) + "}]",
        lambda text, path: files.read_omm(path),
    ),
    "Horizons": (HORIZONS, lambda text, path: files.read_horizons(path)),
    "CSV": (SPEED, by_name),
    "log": (GYRO, log),
    "ALCDEF": (BODIES["alcdef.txt"], lambda text, path: files.read_light_curve(path)),
    "DAMIT": (BODIES["lc.txt"], lambda text, path: files.read_light_curves(path)[0]),
    "OBJ": (BODIES["a.obj"], lambda text, path: shapes.obj(path, density=1.0)),
    "URDF": (BODIES["a.urdf"], lambda text, path: files.read_urdf_inertia(path)),
    "MJCF": (BODIES["a.xml"], lambda text, path: files.read_mjcf_inertia(path)),
}


def same(found, plain):
    assert str(found) == str(plain)


def has(name, value):
    """A check that an attribute has this value."""

    def check(found, plain):
        assert str(getattr(plain, name)) != str(value)
        assert str(getattr(found, name)) == str(value)

    return check


def scale(name):
    def check(found, plain):
        assert (str(found.epoch), plain.epoch.scale) == (f"{plain.epoch.iso()} {name}", "UTC")

    return check


def rows(first, last):
    """A check that the rows from one to another are those of the whole file, from their own epoch."""

    def check(found, plain):
        kept = slice(first, last + 1)
        start = plain.times[first]
        np.testing.assert_array_equal(found.times, plain.times[kept] - start)
        assert found.epoch == plain.epoch + float(start)
        for name in ("positions", "velocities", "attitudes"):
            if hasattr(found, name):
                np.testing.assert_array_equal(getattr(found, name), getattr(plain, name)[kept])

    return check


def conjugate(found, plain):
    np.testing.assert_array_equal(abs(found.attitudes), abs(plain.attitudes))
    np.testing.assert_array_equal(np.sign(found.attitudes[0]), np.sign(plain.attitudes[0] * [1, -1, -1, -1]))


def scalar_first(found, plain):
    np.testing.assert_array_equal(abs(found.attitudes), abs(np.roll(plain.attitudes, -1, axis=1)))


def faster(factor, part):
    """A check that positions (or velocities) are so many times larger."""

    def check(found, plain):
        np.testing.assert_allclose(getattr(found, part), factor * getattr(plain, part), rtol=1e-12)

    return check


def moments(*expected):
    def check(found, plain):
        assert not np.allclose(
            np.diag(np.asarray(plain.inertia)) if np.ndim(plain.inertia) == 2 else plain.inertia, expected
        )
        J = np.asarray(found.inertia)
        np.testing.assert_allclose(np.diag(J) if J.ndim == 2 else J, expected, rtol=0, atol=1e-9)

    return check


def stated(key, value):
    def check(found, plain):
        assert found.metadata[key] == value
        np.testing.assert_array_equal(found.brightness, plain.brightness)

    return check


META = "TIME_SYSTEM = UTC\n"
USEABLE = "USEABLE_START_TIME = 2024-03-01T00:01:30\n", "USEABLE_STOP_TIME = 2024-03-01T00:00:30\n"
FIELDS = [
    ("OEM", "REF_FRAME", "EME2000", "TEME", has("frame", "TEME")),
    ("OEM", "REF_FRAME", "EME2000", "ITRF2014", "ITRF2014 rotate"),
    ("OEM", "REF_FRAME", "EME2000", "GTOD", "GTOD rotate"),
    ("OEM", "REF_FRAME_EPOCH", META, f"{META}REF_FRAME_EPOCH = 2000-01-01\n", "REF_FRAME_EPOCH must be left out"),
    ("OEM", "CENTER_NAME", "= EARTH", "= MOON", has("center", "MOON")),
    ("OEM", "TIME_SYSTEM", "= UTC", "= TDB", scale("TDB")),
    ("OEM", "TIME_SYSTEM", "= UTC", "= GMST", "TIME_SYSTEM must be one of"),
    ("OEM", "TIME_SYSTEM", "= UTC", "= TCB", "TIME_SYSTEM must be one of"),
    ("OEM", "INTERPOLATION", META, f"{META}INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 1\n", same),
    ("OEM", "USEABLE_START_TIME", META, META + USEABLE[0], rows(1, 2)),
    ("OEM", "USEABLE_STOP_TIME", META, META + USEABLE[1], rows(0, 1)),
    ("OEM", "USEABLE", META, META + USEABLE[0] + USEABLE[1], "USEABLE_STOP_TIME must be a time of the rows, and"),
    ("OEM", "STOP_TIME", "STOP_TIME = 2024-03-01T00:02", "STOP_TIME = 2024-03-01T00:09", "miss 420 s at STOP_TIME"),
    ("AEM", "REF_FRAME_A", "EME2000", "ITRF-93", "ITRF-93 rotate"),
    ("AEM", "REF_FRAME_A", "EME2000", "LVLH", "LVLH rotate"),
    ("AEM", "REF_FRAME_A", "EME2000", "GCRF", has("frame_a", "GCRF")),
    ("AEM", "REF_FRAME_B", "A = EME2000\nREF_FRAME_B = SC_BODY_1", "A = SC_BODY_1\nREF_FRAME_B = EME2000", conjugate),
    ("AEM", "REF_FRAME_EPOCH", META, f"{META}REF_FRAME_EPOCH = 2000-01-01\n", "REF_FRAME_EPOCH must be left out"),
    ("AEM", "ATTITUDE_DIR", "A2B", "B2A", conjugate),
    ("AEM", "QUATERNION_TYPE", "LAST", "FIRST", scalar_first),
    ("AEM", "ATTITUDE_TYPE", "= QUATERNION\n", "= SPIN\n", "ATTITUDE_TYPE must be one of"),
    ("AEM", "TIME_SYSTEM", "= UTC", "= GPS", scale("GPS")),
    ("AEM", "TIME_SYSTEM", "= UTC", "= SCLK", "TIME_SYSTEM must be one of"),
    ("AEM", "USEABLE_START_TIME", META, META + USEABLE[0], rows(1, 2)),
    ("AEM", "INTERPOLATION_METHOD", META, f"{META}INTERPOLATION_METHOD = LINEAR\n", same),
    *(("TLE", "ephemeris type", "-4 0  2927", f"-4 {x}  292{(7 + int(x or 0)) % 10}", same) for x in "02"),
    ("TLE", "ephemeris type", "-4 0  2927", "-4    2927", same),
    *(
        ("TLE", "ephemeris type", "-4 0  2927", f"-4 {x}  292{(7 + int(x)) % 10}", rf"ephemeris type .*got '{x}'")
        for x in "134569"
    ),
    *(
        row
        for kind, write in {
            "OMM": lambda key, value: ("NORAD_CAT_ID", f"{key} = {value}\nNORAD_CAT_ID"),
            "XML": lambda key, value: ("<NORAD_CAT_ID>", f"<{key}>{value}</{key}><NORAD_CAT_ID>"),
            "JSON": lambda key, value: ('"NORAD_CAT_ID"', f'"{key}": "{value}", "NORAD_CAT_ID"'),
        }.items()
        for row in (
            (kind, "EPHEMERIS_TYPE", *write("EPHEMERIS_TYPE", 4), "EPHEMERIS_TYPE must be 0, as SGP4 needs, got '4'"),
            (kind, "EPHEMERIS_TYPE", *write("EPHEMERIS_TYPE", 0), same),
            (kind, "EPHEMERIS_TYPE", *write("EPHEMERIS_TYPE", ""), same),
            (kind, "GM", *write("GM", 398600.8), same),
            (kind, "GM", *write("GM", 42828.37), "GM must be 398600.8"),
            (kind, "BTERM", *write("BTERM", 0.01), "BTERM must be left out"),
            (kind, "AGOM", *write("AGOM", 0.01), "AGOM must be left out"),
            (kind, "REF_FRAME_EPOCH", *write("REF_FRAME_EPOCH", "2000-01-01"), "REF_FRAME_EPOCH must be left out"),
            (kind, "MEAN_ELEMENT_THEORY", "SGP/SGP4", "DSST", "MEAN_ELEMENT_THEORY must be SGP4"),
            (kind, "MEAN_ELEMENT_THEORY", "SGP/SGP4", "SGP4-XP", "MEAN_ELEMENT_THEORY must be SGP4"),
            (kind, "REF_FRAME", "TEME", "EME2000", "REF_FRAME must be TEME"),
            (kind, "CENTER_NAME", "EARTH", "MARS", "CENTER_NAME must be EARTH"),
            (kind, "TIME_SYSTEM", "UTC", "TAI", "TIME_SYSTEM must be UTC"),
        )
    ),
    ("OMM", "units", "= 51.6416", "= 51.6416 [deg]", same),
    ("OMM", "units", "= 51.6416", "= 0.9013 [rad]", r"unit of INCLINATION must be deg, got 'rad'"),
    ("OMM", "units", "15.72125391", "0.00114 [rad/s]", r"unit of MEAN_MOTION must be rev/day, got 'rad/s'"),
    ("XML", "units", 'units="deg"', 'units="rad"', r"unit of INCLINATION must be deg, got 'rad'"),
    ("XML", "units", 'units="1/ER"', 'units="1/km"', r"unit of BSTAR must be 1/ER, got '1/km'"),
    ("Horizons", "Output units", "KM-S", "KM-D", faster(1 / 86400, "velocities")),
    ("Horizons", "Output units", "KM-S", "AU-D", faster(149597870.7, "positions")),
    ("Horizons", "Start time", "0000 TDB\nOutput", "0000 UT\nOutput", has("epoch", "2024-03-01T00:00:00 UTC")),
    ("Horizons", "Start time", "0000 TDB\nOutput", "0000 UT+02:00\nOutput", "the scale of the times must be"),
    ("Horizons", "Output type", "GEOMETRIC", "LT+S apparent", "the states must be geometric"),
    ("Horizons", "Reference frame", ": ICRF", ": Ecliptic of J2000.0", has("frame", "Ecliptic of J2000.0")),
    (
        "Horizons",
        "Reference frame",
        ": ICRF",
        ": FK4/B1950.0\nCoordinate systm: Ecliptic",
        has("frame", "Ecliptic, B1950"),
    ),
    ("Horizons", "Center body name", "Earth (399)", "Moon (301)", has("center", "Moon (301)")),
    ("Horizons", "Center-site name", "Start time", "Center-site name: BODY CENTER\nStart time", same),
    (
        "Horizons",
        "Center-site name",
        "Start time",
        "Center-site name: Goldstone\nStart time",
        r"Center-site name BODY CENTER",
    ),
    ("CSV", "units", "x [km]", "x [m]", r"the column 'x \[m\]' states its unit, and is read in km: give m"),
    ("CSV", "units", "(km/s)", "(m/s)", r"the column 'vx \(m/s\)' states its unit, and is read in km/s"),
    ("CSV", "units", "t [s]", "t [min]", r"the column 't \[min\]' states its unit, and is read in s: give min"),
    ("CSV", "units", "x [km]", "x (ICRF)", same),
    ("log", "units", "wx [rad/s]", "wx [deg/s]", r"the column 'wx \[deg/s\]' states its unit, and is read in rad/s"),
    ("log", "units", "wx [rad/s]", "wx (°/s)", r"states its unit, and is read in rad/s: give deg/s"),
    ("log", "units", "time [s]", "time (ms)", r"the column 'time \(ms\)' states its unit, and is read in s: give ms"),
    ("log", "units", "wx [rad/s]", "wx [raw]", same),
    ("ALCDEF", "DELIMITER", "PIPE", "TAB", "DATA needs a date and a magnitude"),
    ("ALCDEF", "LTCAPP", "LTCAPP=NONE", "LTCAPP=MINUS", has("light_time_corrected", True)),
    ("ALCDEF", "DIFFERMAGS", "LTCAPP=NONE", "LTCAPP=NONE\nDIFFERMAGS=TRUE", has("calibrated", False)),
    ("ALCDEF", "REDUCEDMAGS", "LTCAPP=NONE", "LTCAPP=NONE\nREDUCEDMAGS=AVG", stated("REDUCEDMAGS", "AVG")),
    ("ALCDEF", "MAGADJUST", "LTCAPP=NONE", "LTCAPP=NONE\nMAGADJUST=0.3", stated("MAGADJUST", "0.3")),
    ("ALCDEF", "dates", "=2450000.5|", "=50000.0|", r"a Julian date must be from .*, got 50000; perhaps epoch\(mjd"),
    ("DAMIT", "calibration", "2 0\n", "2 1\n", has("calibrated", True)),
    ("DAMIT", "dates", "2450000.5 1.5", "50000.0 1.5", "a Julian date must be from"),
    ("OBJ", "weight of a vertex", "v 0 0 1\n", "v 0 0 1 1\n", same),
    ("OBJ", "weight of a vertex", "v 0 0 1\n", "v 0 0 1 2\n", "the weight w of a vertex x y z w must be 1"),
    ("URDF", "rpy", 'rpy="0 0 0"', 'rpy="0 0 1.5707963267948966"', moments(1.1, 1.0, 1.2)),
    ("URDF", "quat_xyzw", 'rpy="0 0 0"', 'quat_xyzw="0 0 0 1"', "<origin> must have xyz and rpy only, got quat_xyzw"),
    ("MJCF", "quat", "mass=", 'quat="1 0 0 1" mass=', moments(1.1, 1.0, 1.2)),
]


def checksums(text):
    """The lines of a TLE with their checksums."""
    return "\n".join(
        f"{x[:68]}{sum(int(c) if c.isdigit() else c == '-' for c in x[:68]) % 10}" if x[:2] in ("1 ", "2 ") else x
        for x in text.split("\n")
    )


@pytest.mark.parametrize(("kind", "field", "old", "new", "result"), FIELDS, ids=[f"{x[0]} {x[1]}" for x in FIELDS])
def test_a_field_that_changes_others_is_read_or_refused(kind, field, old, new, result, tmp_path):
    text, read = READERS[kind]
    assert old in text
    changed = text.replace(old, new, 1)
    endings = {"OBJ": ".obj", "URDF": ".urdf", "MJCF": ".xml"}
    path, plain = (tmp_path / f"{name}{endings.get(kind, '')}" for name in ("file", "plain"))
    path.write_text(checksums(changed) if kind == "TLE" else changed)
    plain.write_text(text)
    if isinstance(result, str):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises((ValueError, UserWarning), match=result) as caught:
                read(changed, path)
        assert str(caught.value).startswith(str(path))
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of velocities that do not fit to positions in other units
        result(read(changed, path), read(text, plain))


def test_rates_follow_the_frame_that_they_are_in(tmp_path):
    """ANGVEL_FRAME is needed and honored; rates of Euler angles, whose frame is RATE_FRAME, are not read."""
    rows = AEM.replace("QUATERNION\n", "QUATERNION/ANGVEL\nANGVEL_FRAME = SC_BODY_1\n").replace("0.8\n", "0.8 6 0 0\n")
    path, found = tmp_path / "a.aem", {}
    for frame in ("SC_BODY_1", "EME2000"):
        path.write_text(rows.replace("ANGVEL_FRAME = SC_BODY_1", f"ANGVEL_FRAME = {frame}"))
        found[frame] = files.read_aem(path)
    np.testing.assert_allclose(found["SC_BODY_1"].rates, np.radians([[6.0, 0, 0]] * 3), rtol=1e-15)
    w, *v = found["EME2000"].attitudes[1]  # from body to space
    c, s = w * w - v[1] * v[1], 2 * w * v[1]  # about y by φ: the body's components of x are (cos φ, 0, sin φ)
    np.testing.assert_allclose(found["EME2000"].rates[1], np.radians([6 * c, 0, 6 * s]), rtol=0, atol=1e-15)
    path.write_text(rows.replace("ANGVEL_FRAME = SC_BODY_1\n", ""))
    with pytest.raises(ValueError, match="must have ANGVEL_FRAME"):
        files.read_aem(path)


def test_segments_that_overlap_beyond_their_useable_times_are_joined(tmp_path):
    head, meta = OEM.split("META_START")
    rows = meta.split("COMMENT a circle\n")[1]
    first, second = (f"META_START{meta.split('COMMENT a circle')[0]}" for _ in "ab")
    path = tmp_path / "a.oem"
    at = "_TIME = 2024-03-01T00:01:00\nMETA_STOP"
    path.write_text(
        head
        + first.replace("META_STOP", f"USEABLE_STOP{at}")
        + rows
        + second.replace("META_STOP", f"USEABLE_START{at}")
        + rows
    )
    plain = tmp_path / "plain"
    plain.write_text(OEM)
    same(files.read_oem(path), files.read_oem(plain))


@pytest.mark.parametrize("option", ['coordinate="global"', 'fusestatic="true"'])
def test_options_of_mujoco_that_change_inertias_are_left_to_it(option, tmp_path):
    """Global coordinates are refused by MuJoCo; a body that it fuses with the world has no inertia of its own."""
    pytest.importorskip("mujoco")
    path = tmp_path / "a.xml"
    path.write_text(BODIES["a.xml"].replace("<worldbody>", f"<compiler {option}/><worldbody>"))
    with pytest.raises(ValueError, match=r"mujoco cannot compile it|body must be the name of one with an inertia"):
        files.read_mjcf_inertia(path, "a")
