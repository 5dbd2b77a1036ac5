"""The command `lieint files` describes files of other software, and refuses what it cannot read in one line."""

import shutil
from pathlib import Path

import data_files
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.command import cli

EPOCH = "2024-03-01T12:00:00 UTC"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder with one file of each format."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(data_files.FOLDER / "samples" / "jobs", tmp_path, dirs_exist_ok=True)


def write_orbit():
    orbit = li.orbits.kepler(li.orbits.EARTH_GM, 7578.0, 0.1, 0.9, node=0.7, periapsis=1.5)
    facts = dict(epoch=EPOCH, frame="EME2000", center="EARTH", object="SAT")
    li.files.write_oem("sat.oem", orbit, times=np.arange(-60.0, 900.0, 10.0), **facts)


@pytest.mark.parametrize(
    ("file", "parts"),
    [
        ("sat.oem", ["CCSDS OEM", "SAT about EARTH, axes EME2000", "96 states", 'read_oem("sat.oem")']),
        ("sat.aem", ["CCSDS AEM", "11 attitudes from 2024-03-01T12:00:00 UTC over 1 s", "read_aem("]),
        ("iss.tle", ["TLE", "ISS (ZARYA), mean elements of 2024-03-01T12:00:00", "15.4956 revolutions a day"]),
        ("box.obj", ["8 vertices, 12 triangles, 2 × 1 × 3, volume 6", "read_shape("]),
        ("arm.urdf", ["URDF", 'read_urdf_inertia("arm.urdf", link)']),
        ("water.xyz", ["1 molecule(s), the first of 3 atoms and 18.01"]),
        ("lc.txt", ["1 curve(s) of 2 points, JD 2451545.00000 to 2451545.10000"]),
        ("sat.csv", ["11 rows of time, q_w, q_x, q_y, q_z, angular_velocity_x"]),
    ],
)
def test_a_file_is_described(file, parts, lieint):
    write_orbit()
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    state = body.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    run = li.run(li.schemes.so3_midpoint(body), state, 0.1, 10, epoch=EPOCH, progress=False)
    li.files.write_aem("sat.aem", run, object="SAT")
    li.files.write_csv("sat.csv", run)
    out = lieint("files", file)
    assert [part for part in parts if part not in out] == [], out


def test_a_file_of_no_format_is_refused(lieint):
    Path("noise.bin").write_bytes(bytes(range(256)))
    assert "noise.bin has none of the formats OEM, AEM" in lieint.refuse("files", "noise.bin")


def test_files_before_one_that_is_refused_are_described(lieint, capsys):
    assert cli.main(["files", "box.obj", "nothing.oem"]) == 2
    out, err = capsys.readouterr()
    assert "box.obj: a surface of triangles" in out
    assert "there is no file nothing.oem" in err
