"""Surfaces from files: one body in every format, what archives write, and another package as reference."""

import gzip
import re

import cubes
import numpy as np
import pytest
from cubes import CUBE, QUADS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

import lieint_jax as li
from lieint_jax import files, shapes

FACES = np.array(cubes.FACES)


def rows(table, prefix=""):
    return "".join(prefix + " ".join(str(x) for x in row) + "\n" for row in table.tolist())


def numbered(table, base):
    return "".join(f"{k} " + " ".join(map(str, row)) + "\n" for k, row in enumerate(table.tolist(), base))


def ply(at, faces, order=None, polygons=None):
    """A PLY file with a color, a list that is no index, and an element between the two."""
    form = {None: "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    polygons = faces.tolist() if polygons is None else polygons
    head = (
        f"ply\nformat {form} 1.0\ncomment made\nelement vertex {len(at)}\nproperty double x\nproperty uchar red\n"
        "property double y\nproperty double z\nelement edge 1\nproperty list uchar short ends\n"
        f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nproperty float weight\nend_header\n"
    )
    if order is None:
        body = "".join(f"{x} 7 {y} {z}\n" for x, y, z in at.tolist()) + "2 0 1\n"
        return (head + body + "".join(f"{len(p)} {' '.join(map(str, p))} 0.5\n" for p in polygons)).encode()
    vertex = np.zeros(len(at), [("x", order + "f8"), ("red", "u1"), ("y", order + "f8"), ("z", order + "f8")])
    vertex["x"], vertex["y"], vertex["z"] = at.T
    body = vertex.tobytes() + bytes([2]) + np.array([0, 1], order + "i2").tobytes()
    for p in polygons:
        body += bytes([len(p)]) + np.array(p, order + "i4").tobytes() + np.array(0.5, order + "f4").tobytes()
    return head.encode() + body


def stl(corners):
    records = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["corners"] = corners
    return b"solid or not".ljust(80) + len(corners).to_bytes(4, "little") + records.tobytes()


def stl_text(corners):
    facets = "".join(f"facet normal 0 0 0\n outer loop\n{rows(c, '  vertex ')} endloop\nendfacet\n" for c in corners)
    return f"solid x\n{facets}endsolid x\n".encode()


FORMATS = {
    "a.obj": lambda at, F: (rows(at, "v ") + rows(F + 1, "f ")).encode(),
    "b.obj": lambda at, F: (rows(at, "v ") + rows(F - len(at), "f ")).encode(),
    "c.ply": ply,
    "d.ply": lambda at, F: ply(at, F, "<"),
    "e.PLY": lambda at, F: ply(at, F, ">"),
    "shape.txt": lambda at, F: (f"{len(at)} {len(F)}\n" + rows(at) + rows(F + 1)).encode(),
    "vf.tab": lambda at, F: (rows(at, "v ") + rows(F + 1, "f ")).encode(),
    "zero.tab": lambda at, F: (f"{len(at)} {len(F)}\n" + rows(at) + rows(F)).encode(),
    "numbered.tab": lambda at, F: (f"{len(at)}, {len(F)}\n" + numbered(at, 0) + numbered(F, 0)).encode(),
    "ver.tab": lambda at, F: (f"{len(at)}\n{numbered(at, 1)}{len(F)}\n{numbered(F + 1, 1)}").encode(),
    "f.stl": lambda at, F: stl_text(at[F]),
    "g.stl": lambda at, F: stl(at[F]),
}


def hull(seed, count=30):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype("float32") * np.float32([4, 2, 1])
    points = points.astype(float)
    found = ConvexHull(points)
    at, faces = points[found.vertices], np.searchsorted(found.vertices, found.simplices)
    a, b, c = (at[faces[:, k]] for k in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    return at, np.where(inward[:, None], faces[:, ::-1], faces)


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("name", FORMATS)
def test_a_body_is_the_same_in_every_format(name, zipped, tmp_path):
    at, faces = hull(3)
    path = tmp_path / (name + ".gz" * zipped)
    data = FORMATS[name](at, faces)
    path.write_bytes(gzip.compress(data) if zipped else data)
    vertices, triangles = shapes.surface(path, closed=True)
    assert len(vertices) == len(at)
    np.testing.assert_array_equal(vertices[triangles], at[faces])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(sorted(FORMATS)), st.sampled_from(["\n", "\r\n", "\r"]))
def test_ends_of_lines_marks_and_exponents_of_fortran_change_nothing(tmp_path_factory, seed, name, end):
    at, faces = hull(seed, 8)
    data = FORMATS[name](at, faces)
    if b"\0" not in data:
        text = "\ufeff" + data.decode().replace("\n", end)
        data = re.sub(r"(\d\.\d\d+)(?=\s)", r"\1D+00", text).encode()
    path = tmp_path_factory.mktemp("a") / name
    path.write_bytes(data)
    vertices, triangles = shapes.surface(path, closed=True)
    np.testing.assert_array_equal(vertices[triangles], at[faces])


@pytest.mark.parametrize("order", [None, "<", ">"])
def test_polygons_of_ply_are_cut(order, tmp_path):
    path = tmp_path / "cube.ply"
    path.write_bytes(ply(CUBE, FACES, order, QUADS))
    vertices, triangles = shapes.surface(path, closed=True)
    np.testing.assert_array_equal(vertices[triangles], CUBE[FACES])


def test_faces_without_area_and_seams_are_harmless(tmp_path):
    """Each face with vertices of its own, as CAD writes them, and slivers with two corners at one place."""
    corners = np.concatenate([CUBE[FACES], CUBE[[[0, 0, 1], [3, 1, 3]]]])
    path = tmp_path / "cube.stl"
    path.write_bytes(stl(corners))
    found = files.read_shape(path, density=2.0, scale=3.0)
    assert float(found.mass) == pytest.approx(54.0, rel=1e-14, abs=0)
    np.testing.assert_allclose(found.inertia, np.eye(3) * 54 * 9 / 6, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.center, [1.5] * 3, rtol=1e-14)


def test_another_package_finds_the_same_mass_center_and_inertia(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    at, faces = hull(5)
    solid = trimesh.Trimesh(at, faces)
    for name in ("a.off", "a.glb", "a.ply", "a.stl", "a.obj"):
        solid.export(tmp_path / name)
        found = files.read_shape(tmp_path / name, density=3.0)
        solid.density = 3.0
        assert float(found.mass) == pytest.approx(solid.mass, rel=1e-6)  # .stl and .glb are in single precision
        np.testing.assert_allclose(found.center, solid.center_mass, rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.inertia, solid.moment_inertia, rtol=0, atol=1e-6 * solid.mass * 16)
    (tmp_path / "b.off").write_text("OFF\n1 1 0\n")
    with pytest.raises(ValueError, match=r"trimesh cannot read .*b\.off"):
        files.read_shape(tmp_path / "b.off", mass=1.0)


def test_bad_stl_files_are_refused(tmp_path):
    text, binary = tmp_path / "cube.stl", tmp_path / "binary.STL"
    text.write_text("solid cube\nouter loop\n vertex 0 0 x\n vertex 1 0 0\n vertex 0 1 0\nendloop")
    with pytest.raises(ValueError, match=r"cube\.stl, line 3: a coordinate must be a finite number, got 'x'"):
        shapes.surface(text)
    binary.write_bytes(stl(CUBE[FACES])[:-1])
    with pytest.raises(ValueError, match=r"binary\.STL: 12 triangles of 50 bytes must follow"):
        shapes.surface(binary)


def test_a_format_that_needs_trimesh_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    (tmp_path / "a.glb").write_bytes(b"glTF")
    with pytest.raises(ImportError, match=r"a\.glb needs the package trimesh .*\.obj, \.stl, \.ply, \.txt, \.tab"):
        files.read_shape(tmp_path / "a.glb", mass=1.0)
    with pytest.raises(ValueError, match=r"\.obj, \.stl, \.ply, \.txt, \.tab, each also with \.gz, got .*a\.glb"):
        shapes.surface(tmp_path / "a.glb")


def test_an_open_surface_is_read_to_draw_it_but_is_no_body(tmp_path):
    path = tmp_path / "open.obj"
    path.write_text(rows(CUBE, "v ") + rows(FACES[:-1] + 1, "f "))
    assert len(shapes.surface(path)[1]) == 11
    for read in (lambda: shapes.obj(path, mass=1.0), lambda: files.read_shape(path, mass=1.0)):
        with pytest.raises(ValueError, match=r"open\.obj, line 9: the surface must be closed, but 3 edges"):
            read()
    path.write_text(path.read_text() + "f 2 8 4")
    assert float(files.read_shape(path, density=1.0).mass) == pytest.approx(1.0, rel=1e-14, abs=0)
    assert li.shapes.obj(path, density=1.0).mass.dtype == "float64"
