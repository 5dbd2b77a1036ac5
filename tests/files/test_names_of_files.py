"""Errors name the file, and no name of a file reaches a terminal with control characters."""

import shutil

import data_files
import numpy as np
import pytest
from cubes import CUBE, FACES

from lieint_jax import files, shapes

ODD = "a\x1b[2J\u202e\x07"
READERS = {
    "oem": files.read_oem,
    "aem": files.read_aem,
    "tle": files.read_tle,
    "omm": files.read_omm,
    "horizons": files.read_horizons,
    "csv": lambda path: files.read_csv_log(path, time=0, rates=[1, 2, 3]),
    "eph": lambda path: files.read_ephemeris_csv(path, time="t", positions="xyz", velocities="uvw", unit_length="km"),
    "obj": lambda path: files.read_shape(path, density=1.0),
    "own.obj": lambda path: shapes.obj(path, density=1.0),
    "stl": shapes.surface,
    "ply": shapes.surface,
    "tab": shapes.surface,
    "off": lambda path: files.read_shape(path, density=1.0),
    "glb": shapes.surface,
    "xyz": files.read_molecules,
    "pdb": files.read_molecules,
    "cif": files.read_molecules,
    "txt": files.read_light_curve,
    "urdf": files.read_urdf_inertia,
    "xml": files.read_mjcf_inertia,
    "any": files.describe,
    "gz": files.describe,
}
DATA = {
    "nothing": None,
    "empty": b"",
    "no text": b"\0\xff\xfe binary",
    "Latin-1": b"\xe9\n",
    "words": b"some words, and more\nof them\n",
    "binary STL": b"\0" * 90,
    "PLY": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n2 0 0\n",
}


@pytest.mark.parametrize("kind", READERS)
def test_an_error_names_the_file_in_printable_characters(kind, tmp_path):
    path = tmp_path / f"{ODD}.{kind}"
    for name, data in DATA.items():
        if kind == "any" and name == "words":
            continue  # which are described as a table
        if data is not None:
            path.write_bytes(data)
        with pytest.raises((ValueError, ImportError)) as caught:
            READERS[kind](path)
        message = str(caught.value)
        assert message.replace("\n", "").isprintable()
        assert r"a\x1b[2J\u202e\x07." in message


def test_a_description_and_warnings_are_printable(tmp_path):
    for sample in ("orbit.oem", "orbit.aem", "orbit.tle", "orbit.horizons", "bodies/a.obj", "bodies/a.pdb", "arm.urdf"):
        path = tmp_path / f"{ODD}.{sample.rpartition('.')[2]}"
        shutil.copy(data_files.FOLDER / "samples" / sample, path)
        found = files.describe(path)
        assert found.count(r"a\x1b[2J\u202e\x07.") >= 2
        assert all(line.isprintable() for line in found.split("\n"))
    path = tmp_path / f"{ODD}.oem"
    path.write_text(data_files.text("samples/orbit.oem").replace("EME2000", "ITRF\x1b[2J"))
    with pytest.warns(UserWarning, match=r"oem: the axes ITRF.x1b.2J rotate") as caught:
        files.read_oem(path)
    assert all(str(warning.message).isprintable() for warning in caught)


def surface(corners, faces):
    rows = [*(("v", *map(float, x)) for x in corners), *(("f", *(k + 1 for k in face)) for face in faces)]
    return "".join(" ".join(map(str, row)) + "\n" for row in rows)


@pytest.mark.parametrize(
    ("corners", "faces", "words"),
    [
        (CUBE, FACES[:-1], r"line \d+: the surface must be closed, but 3 edges"),
        (CUBE, [*FACES[:-1], FACES[-1][::-1]], r"line \d+: this face and that of line \d+ run along"),
        (CUBE * [1, 1, 0], FACES, "."),
        (CUBE * [1, 1, 1e-30], FACES, "the mesh must enclose a volume, got"),
        (CUBE * 1e61, FACES, r"line \d+: a vertex of this face is not finite, or beyond 2.8e\+60"),
        (CUBE * 1e308, FACES, r"line \d+: a vertex of this face is not finite, or beyond"),
    ],
)
def test_errors_of_surfaces_name_the_file(corners, faces, words, tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(surface(np.asarray(corners, float), faces))
    for read in (
        files.describe,
        lambda path: files.read_shape(path, density=1.0),
        lambda path: shapes.obj(path, mass=1.0),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            read(path)
        assert str(caught.value).startswith(str(path))
    scaled = tmp_path / "b.obj"
    scaled.write_text(surface(CUBE, FACES))
    with pytest.raises(ValueError, match=r"b\.obj: coordinates must be at most 2\.8e\+60, .* got 1e\+61"):
        files.read_shape(scaled, density=1.0, scale=1e61)


def test_a_mesh_has_finite_moments_or_is_refused():
    """By a box of the same edges, to the largest coordinate that is accepted."""
    for size in (1e-40, 1.0, 2.7e60):
        found = shapes.mesh(size * CUBE, FACES, mass=1.0)
        np.testing.assert_allclose(found.inertia, size * size / 6 * np.eye(3), rtol=0, atol=1e-12 * size * size)
        assert np.isfinite(float(shapes.mesh(size * CUBE, FACES, density=1.0).mass))
    for size in (2.9e60, 1e103, 1e308):
        with pytest.raises(ValueError, match=r"coordinates must be at most 2\.8e\+60, beyond which moments of inertia"):
            shapes.mesh(size * CUBE, FACES, mass=1.0)
