"""One change of a good file each, with its decided result: read as before, or one sentence with file and line."""

import numpy as np
import pytest

from lieint_jax import files, shapes

CORNERS = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 1]]
FACES = [
    [1, 2, 4], [1, 4, 3], [5, 7, 8], [5, 8, 6], [1, 5, 6], [1, 6, 2],
    [3, 4, 8], [3, 8, 7], [1, 3, 7], [1, 7, 5], [2, 6, 8], [2, 8, 4],
]  # fmt: skip


def lines(rows, prefix=""):
    return "".join(prefix + " ".join(map(str, row)) + "\n" for row in rows)


def numbered(rows):
    return lines([k, *row] for k, row in enumerate(rows, 1))


def facet(face):
    return f"facet normal 0 0 0\nouter loop\n{lines([CORNERS[k - 1] for k in face], 'vertex ')}endloop\nendfacet\n"


PLY = (
    "ply\nformat {}\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face 12\n"
    "property list uchar int vertex_indices\nend_header\n"
)
ZERO = [[k - 1 for k in face] for face in FACES]
FIN = "v 1 1 2\nv 2 1 1\nf 8 7 9\nf 7 8 10\nf 8 9 10\nf 9 7 10\n"
RECORDS = np.zeros(12, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
RECORDS["corners"] = np.array(CORNERS)[ZERO]
POINT = "{} 1.5 1 0.1 0.2 0.3 1 0.5\n"
SESSION = (
    "STARTMETADATA\nOBJECTNAME=Eros\nDELIMITER=PIPE\nLTCAPP=NONE\nENDMETADATA\n"
    "DATA=2450000.5|14.2|0.01\nDATA=2450000.6|14.1|0.01\nENDDATA\n"
)
GOOD = {
    "a.obj": lines(CORNERS, "v ") + lines(FACES, "f "),
    "a.stl": "solid a\n" + "".join(map(facet, FACES)) + "endsolid a\n",
    "a.ply": PLY.format("ascii 1.0") + lines(CORNERS) + lines([3, *face] for face in ZERO),
    "a.txt": "8 12\n" + lines(CORNERS) + lines(FACES),
    "a.tab": "8\n" + numbered(CORNERS) + "12\n" + numbered(FACES),
    "b.ply": PLY.format("binary_little_endian 1.0").encode()
    + np.array(CORNERS, "<f4").tobytes()
    + b"".join(b"\3" + np.array(face, "<i4").tobytes() for face in ZERO),
    "b.stl": b"a cube".ljust(80) + (12).to_bytes(4, "little") + RECORDS.tobytes(),
    "a.urdf": '<robot>\n<link name="a">\n<inertial>\n<origin xyz="1 0 0" rpy="0 0 0"/>\n<mass value="2.0"/>\n'
    '<inertia ixx="1.0" ixy="0" ixz="0" iyy="1.1" iyz="0" izz="1.2"/>\n</inertial>\n</link>\n</robot>\n',
    "a.xml": '<mujoco>\n<worldbody>\n<body name="a">\n<inertial pos="1 0 0" mass="2.0" diaginertia="1.0 1.1 1.2"/>\n'
    "</body>\n</worldbody>\n</mujoco>\n",
    "a.xyz": "3\nwater\nO 0.0 0.0 0.1\nH 0.9 0.0 0.0\nH -0.3 0.8 0.0\n",
    "a.pdb": "HETATM    1  O   HOH A   1       0.000   0.000   0.100  1.00  0.00           O\n"
    "HETATM    2  H1  HOH A   1       0.900   0.000   0.000  1.00  0.00           H\n"
    "HETATM    3  H2  HOH A   1      -0.300   0.800   0.000  1.00  0.00           H\nEND\n",
    "lc.txt": "2\n2 0\n" + POINT.format(2450000.5) + POINT.format(2450000.6) + "1 1\n" + POINT.format(2450001.5),
    "lc.json": '[{"LightCurve": {"id": 1, "scale": 0, "points_count": 1,\n'
    '"points": "2450000.5 1.5 1 0.1 0.2 0.3 1 0.5"}}]',
    "alcdef.txt": SESSION,
}


def triangles(path):
    vertices, faces = shapes.surface(path, closed=True)
    return sorted(vertices[face].tolist() for face in faces)


def inertia(shape):
    return shape.mass, shape.center, shape.inertia


def curves(path):
    return [[x.dates, x.brightness, x.sun, x.errors, x.calibrated] for x in files.read_light_curves(path)]


READERS = {
    "a.urdf": lambda path: inertia(files.read_urdf_inertia(path)),
    "a.xml": lambda path: inertia(files.read_mjcf_inertia(path)),
    "a.xyz": lambda path: [(x.elements, x.positions, x.masses) for x in files.read_molecules(path)],
    "a.pdb": lambda path: [(x.elements, x.positions, x.masses) for x in files.read_molecules(path)],
    "lc.txt": curves,
    "lc.json": curves,
    "alcdef.txt": curves,
}
SAME = ""
MUTATIONS = [
    # surfaces: OBJ
    ("a.obj", "v 0 0 0\n", "\ufeffv 0 0 0\n", SAME),
    ("a.obj", "v 0 0 1\n", "v 0 0 1.0D+00 0.5 0.5 0.5\n", SAME),
    ("a.obj", "f 1 2 4\n", "f 1/1/1 2//7 4\n", SAME),
    ("a.obj", "f 1 2 4\n", "f -8 -7 -5\n", SAME),
    ("a.obj", "f 1 2 4\nf 1 4 3\n", "f 1 2 4 3\n", SAME),
    ("a.obj", "f 1 2 4\n", "g part\nusemtl \xe9\nf 1 2 4\nf 1 1 3\n", SAME),
    ("a.obj", "f 1 2 4\n", "f 0 2 4\n", "line 9: a face must have indices .* from −1 back to −8, got '0'"),
    ("a.obj", "f 1 2 4\n", "f 1 2 9\n", r"line 9: a face must have indices of vertices, from 1 to 8, got \[1, 2, 9\]"),
    ("a.obj", "f 1 2 4\n", "f -9 2 4\n", "line 9: a face must have indices .* got '-9'"),
    ("a.obj", "f 1 2 4\n", "f 1 2.5 4\n", "line 9: a face must have indices .* got '2.5'"),
    ("a.obj", "f 1 2 4\n", "f 1 2 " + "9" * 5000 + "\n", "line 9: a face must have indices .* got '9{200}…'"),
    ("a.obj", "f 1 2 4\n", "f 1 2\n", "line 9: a face needs three numbers, got 'f 1 2'"),
    ("a.obj", "f 1 2 4\n", "f 1 4 2\n", "line 9: this face and that of line 1.* run along their common edge"),
    ("a.obj", "f 2 8 4\n", "f 8 2 4\n", "line 20: this face and that of line .* run along their common edge"),
    ("a.obj", "f 1 2 4\n", "f 1 2 4\nf 2 4 1\n", "line 10: this is the face of line 9 again: leave one of them out"),
    ("a.obj", "f 1 2 4\n", "f 1 2 4\nf 2 1 4\n", "line 10: this is the face of line 9 again"),
    ("a.obj", "f 1 2 4\n", "", r"line 9: the surface must be closed, but 3 edges .* from \["),
    ("a.obj", "v 0 0 1\n", "v 0 nan 1\n", "line 2: a coordinate must be a finite number, got 'nan'"),
    ("a.obj", "v 0 0 1\n", "v 0 1\n", "line 2: a vertex needs three numbers, got 'v 0 1'"),
    ("a.obj", "v 0 0 1\n", "v 0 0 1_0\n", "line 2: a coordinate must be a finite number, got '1_0'"),
    ("a.obj", "v 0 0 1\n", "v 0 0 \x1b[31m\n", r"line 2: .* got '\\\\x1b\[31m'"),
    ("a.obj", lines(CORNERS, "v "), "", "there must be vertices and faces, got 0 and 12"),
    ("a.obj", lines(FACES, "f "), "f 1 1 2\n", "no face has its three vertices at different places"),
    ("a.obj", "f 2 8 4\n", f"f 2 8 4\n{FIN}", "line 11: 4 faces, also that of line 24, meet in one edge"),
    # STL
    ("a.stl", "vertex 0 0 0", "VERTEX 0 0 0d0", SAME),
    ("a.stl", "solid a\n", "\ufeffsolid a\n", SAME),
    ("a.stl", "endsolid a\n", "", SAME),
    ("a.stl", "vertex 0 0 0\n", "vertex 0 0\n", "line 4: a vertex needs three numbers, got 'vertex 0 0'"),
    ("a.stl", "vertex 0 0 0\n", "", "line 6: a facet needs three vertices between outer loop and endloop"),
    ("a.stl", "vertex 0 0 0\n", "vertex 0 0 inf\n", "line 4: a coordinate must be a finite number, got 'inf'"),
    ("a.stl", "endloop\nendfacet\nendsolid a\n", "", "line 80: a facet is not finished"),
    ("a.stl", "outer loop", "loop", "line 7: a facet needs three vertices"),
    ("a.stl", "facet", "", SAME),
    ("b.stl", b"a cube", b"solid ", SAME),
    ("b.stl", RECORDS.tobytes()[-1:], b"", r"b\.stl: .* triangles of 50 bytes must follow"),
    ("b.stl", b"\x0c\0\0\0", b"\0\0\0\x80", "2147483648 triangles of 50 bytes must follow the header of 84, got 600"),
    ("b.stl", np.float32(1).tobytes(), np.float32(np.nan).tobytes(), "face 1: a vertex of this face is not finite"),
    # PLY
    ("a.ply", "comment", "comment", SAME),
    ("a.ply", "ply\n", "\ufeffply\n", SAME),
    ("a.ply", "vertex_indices", "vertex_index", SAME),
    ("a.ply", "3 0 1 3\n3 0 3 2\n", "4 0 1 3 2\n", "20 lines of elements must follow the header, got 19"),
    ("a.ply", "ply\n", "plx\n", 'line 1: a PLY file must begin with a line "ply"'),
    ("a.ply", "ascii 1.0", "ascii 2.0", "line 2: no line of the header of a PLY file: 'format ascii 2.0'"),
    ("a.ply", "vertex 8", "vertex 9", "21 lines of elements must follow the header, got 20"),
    ("a.ply", "vertex 8", "vertex -8", "line 3: a number of vertices or faces must be an integer, got '-8'"),
    ("a.ply", "float x", "float q", "the element vertex must have properties x, y and z"),
    ("a.ply", "uchar int", "float int", "line 8: no line of the header"),
    ("a.ply", "vertex_indices", "indices", "line 18: a face needs a list vertex_indices"),
    ("a.ply", "3 0 1 3\n", "3 0 1\n", "line 18: the line has too few numbers: '3 0 1'"),
    ("a.ply", "3 0 1 3\n", "3 0 1 3 3\n", "line 18: the line has too many numbers"),
    ("a.ply", "3 0 1 3\n", "3 0 1 8\n", r"line 18: a face must have .* from 0 to 7, got \[0, 1, 8\]"),
    ("a.ply", "3 0 1 3\n", "3 0 1 -1\n", r"line 18: a face must have .* from 0 to 7, got \[0, 1, -1\]"),
    ("a.ply", "3 0 1 3\n", "3 0 1 2.5\n", "line 18: a face needs a list vertex_indices of three or more integers"),
    ("a.ply", "end_header\n", "", 'line 1: a PLY file must begin with a line "ply" and have a line "end_header"'),
    ("b.ply", b"face 12", b"face 13", "the file ends in element face 13 of 13"),
    ("b.ply", b"face 12", b"face 11", "239 bytes must follow the header, got 252"),
    ("b.ply", b"vertex 8", b"vertex 800000000", "the file ends in element vertex 22 of 800000000"),
    ("b.ply", b"\3\0\0\0\0\1", b"\xff\0\0\0\0\1", "the file ends in element face 1 of 12"),
    ("b.ply", b"little", b"big", r"face 1: a face must have .* from 0 to 7, got \[0, 16777216, 50331648\]"),
    # plate models
    ("a.txt", "8 12\n", "\ufeff8 12\n\n", SAME),
    ("a.txt", "0 0 1\n", "0.0 0,0 1D0\n".replace(",", "."), SAME),
    ("a.txt", lines(FACES), lines(ZERO), SAME),
    ("a.txt", "8 12\n", "8 13\n", "line 1: 8 vertices and 13 faces must follow, got 21 lines in all"),
    ("a.txt", "8 12\n", "8 1e9\n", "line 1: a number of vertices or faces must be an integer, got '1e9'"),
    ("a.txt", "8 12\n", "", "line 1: a plate model must begin with the numbers of vertices and faces"),
    ("a.txt", "\n1 2 4\n", "\n0 2 4\n", r"line .*: a face must have indices of vertices, from 0 to 7, got \[.*8"),
    ("a.txt", "\n1 2 4\n", "\n1 2 4.5\n", r"line 10: the indices of a face must be integers, got \[1.0, 2.0, 4.5\]"),
    ("a.txt", "\n1 2 4\n", "\n1 2 NaN\n", "line 10: a face must be a finite number, got 'NaN'"),
    ("a.txt", "\n1 2 4\n", "\n1 2\n", "line 10: a face needs 3 numbers, as in the lines above, got '1 2'"),
    ("a.txt", lines(CORNERS), lines(CORNERS).replace("1 1 1", "1 1 1 1"), "line 9: a vertex needs 3 numbers"),
    ("a.txt", "8 12\n", "9 12\n5 5 5\n", "no face has vertex 0 or 9: it cannot be told"),
    ("a.tab", "\n1 0 0 0\n", "\n0 0 0 0\n", "line 3: rows of four numbers must be numbered from 0 or 1"),
    ("a.tab", "\n12\n", "\n11\n", "line 1: 8 vertices and 11 faces must follow, got 22 lines"),
    ("a.tab", "8\n1 0 0 0\n", "8\n0 0 0\n", r"quadrilaterals \(ICQ\) and grids of radii are not read"),
    ("a.tab", GOOD["a.tab"], lines(CORNERS, "v ") + lines(FACES, "f "), SAME),
    # robots
    ("a.urdf", "<robot>", '\ufeff<?xml version="1.0"?>\n<robot>', SAME),
    ("a.urdf", 'xyz="1 0 0" rpy="0 0 0"', 'xyz="1D0 0 0"', SAME),
    ("a.urdf", "<robot>", '<!DOCTYPE r [<!ENTITY a "b">]><robot>', r"line 1: a document type is declared \(DOCTYPE\)"),
    ("a.urdf", "<robot>", '<!DOCTYPE r SYSTEM "/etc/passwd"><robot>', "line 1: a document type is declared"),
    ("a.urdf", "</robot>", "", "line 10: this is no XML: no element found"),
    ("a.urdf", GOOD["a.urdf"], GOOD["a.urdf"].replace("robot", "sdf"), "line 1: a URDF begins with <robot>, got <sdf>"),
    ("a.urdf", 'value="2.0"', 'value="0"', "line 3: this is not the inertia of a body: mass must be positive, got 0"),
    ("a.urdf", 'value="2.0"', 'value="${m}"', r"line 5: value must be a finite number, got '\$\{m\}'"),
    ("a.urdf", '<mass value="2.0"/>', "", "line 3: <inertial> needs a <mass>"),
    ("a.urdf", 'izz="1.2"', "", "line 6: <inertia> needs a number izz, got 'None'"),
    ("a.urdf", 'ixx="1.0"', 'ixx="-1.0"', "line 3: this is not the inertia of a body: inertia must be"),
    ("a.urdf", 'xyz="1 0 0"', 'xyz="1 0"', "line 4: <origin> needs xyz of 3 numbers, got '1 0'"),
    ("a.urdf", '<link name="a">', '<link name="a">&a;', "line 2: this is no XML: undefined entity"),
    ("a.xml", 'diaginertia="1.0 1.1 1.2"', 'fullinertia="1.0 1.1 1.2 0 0 0"', SAME),
    ("a.xml", 'pos="1', 'quat="-2 0 0 0" pos="1', SAME),
    ("a.xml", 'pos="1', 'quat="0 0 0 0" pos="1', "line 4: quat must not be 0"),
    ("a.xml", 'pos="1', 'fullinertia="1 1 1 0 0 0" pos="1', "line 4: an inertial needs one of diagin"),
    ("a.xml", 'diaginertia="1.0 1.1 1.2"', 'fullinertia="1 1 1 0 0 0" quat="1 0 0 0"', "line 4: full.* takes no quat"),
    ("a.xml", 'mass="2.0"', "", "line 4: <inertial> needs a number mass"),
    ("a.xml", 'mass="2.0"', 'mass="1e999"', "line 4: mass must be a finite number, got '1e999'"),
    ("a.xml", "</body>\n", '</body>\n<body name="b"/>\n', r"body must be the name of one .* \(a, b\), got None"),
    # molecules
    ("a.xyz", "O 0.0", "8 0.0", SAME),
    ("a.xyz", "3\n", "\ufeff3\n", SAME),
    ("a.xyz", "0.9", "9.0D-01", SAME),
    ("a.xyz", "3\n", "4\n", "line 6: an atom needs an element and three coordinates, got ''"),
    ("a.xyz", "3\n", "2\n", "line 5: a frame of xyz begins with the number of its atoms, got 'H -0.3 0.8 0.0'"),
    ("a.xyz", "3\n", "999999999\n", "line 1: 999999999 atoms must follow"),
    ("a.xyz", "O 0.0", "Qq 0.0", "line 3: no mass is known of 'Qq'"),
    ("a.xyz", "0.9", "nan", "line 4: a coordinate must be a finite number, got 'nan'"),
    ("a.xyz", "H 0.9 0.0 0.0", "H 0.9 0.0", "line 4: an atom needs an element and three coordinates"),
    ("a.xyz", "water", 'Properties=id:I:1:species:S:1:pos:R:3', "line 2: of extended xyz, Properties must begin with"),
    ("a.pdb", "           O\n", "\n", SAME),
    ("a.pdb", "HETATM", "ATOM  ", SAME),
    ("a.pdb", "END\n", "", SAME),
    ("a.pdb", "   0.900", "   *****", r"line 2: a coordinate must be a finite number, got '\s*\*+'"),
    ("a.pdb", "0.000   0.100  1.00  0.00           O", "0.000", "line 1: an atom needs coordinates in columns 31"),
    ("a.pdb", GOOD["a.pdb"], "REMARK\nEND\n", "there are no atoms"),
    # light curves
    ("lc.txt", "2\n2 0\n", "\ufeff2\n\n2 0\n", SAME),
    ("lc.txt", " 1.5 ", " 1.5D0 ", SAME),
    ("lc.txt", "2\n2 0\n", "3\n2 0\n", "a light curve begins with its number of points and 0 or 1, but the file ends"),
    ("lc.txt", "2\n2 0\n", "1\n2 0\n", "line 5: there are more lines than those of 1 light curves"),
    ("lc.txt", "2 0\n", "2 2\n", "line 2: 2 points must follow, and the code be 0"),
    ("lc.txt", "1 1\n", "3 1\n", "line 5: 3 points must follow, .* got 1 lines"),
    ("lc.txt", "2450000.5 1.5 ", "2450000.5 nan ", "line 3: a point must be a finite number, got 'nan'"),
    ("lc.txt", "2450000.5 1.5 ", "2450000.5 -1.5 ", "line 3: the intensity must be positive, and no vector 0"),
    ("lc.txt", " 0.3 1 0.5\n", " 0 0 0\n", "line 3: the intensity must be positive, and no vector 0"),
    ("lc.txt", " 0.3 1 0.5\n", " 0.3 1\n", "line 3: a point needs 8 numbers .*, got 7"),
    ("lc.txt", GOOD["lc.txt"], "", "a file of light curves begins with their number .* but the file ends"),
    ("lc.json", '"scale": 0', '"scale": "0"', SAME),
    ("lc.json", '"points_count": 1', '"points_count": 2', "curve 1 must have 2 points, got 1"),
    ("lc.json", '"scale": 0', '"scale": 7', "curve 1 needs LightCurve with points, a text, and scale, 0 or 1"),
    ("lc.json", "2450000.5 1.5", "2450000.5", "points of curve 1, line 1: a point needs 8 numbers"),
    ("lc.json", "}}]", "}}", "line 2: this is no JSON"),
    ("lc.json", "[", "[" * 100_000, "this is no JSON"),
    ("alcdef.txt", "OBJECTNAME", "# note\nObjectName", SAME),
    ("alcdef.txt", "ENDDATA\n", "", "line 5: the file ends before the block of ENDMETADATA does"),
    ("alcdef.txt", "ENDMETADATA\n", "", "line 7: 'ENDDATA' must not follow STARTMETADATA of line 1"),
    ("alcdef.txt", "|14.2|", "|NaN|", "line 6: DATA must be a finite number, got 'NaN'"),
    ("alcdef.txt", "|14.2|0.01", "|14.2", "line 5: a curve needs lines DATA=…, all of them with an error"),
    ("alcdef.txt", "PIPE", "STAR", "line 6: DELIMITER must be PIPE or TAB, got 'STAR'"),
    ("alcdef.txt", "|14.2|0.01", "", "line 6: DATA needs a date and a magnitude"),
    ("alcdef.txt", "STARTMETADATA\n", "OBJECT=1\nSTARTMETADATA\n", "line 1: 'OBJECT' must be between STARTMETADATA"),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("mutated")


def read(folder, name, data):
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return READERS.get(name, triangles)(path)


@pytest.mark.parametrize(("name", "old", "new", "result"), MUTATIONS, ids=range(len(MUTATIONS)))
def test_a_changed_file(name, old, new, result, folder):
    assert old in GOOD[name] or old == new
    changed = GOOD[name].replace(old, new, 1)
    if result == SAME:
        expected, found = read(folder, name, GOOD[name]), read(folder, name, changed)
        assert str(found) == str(expected)
        return
    with pytest.raises(ValueError, match=result) as error:
        read(folder, name, changed)
    assert name in str(error.value)
    assert len(str(error.value)) < 700
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", GOOD)
def test_ends_of_lines_blanks_at_ends_and_compression_change_nothing(name, folder):
    expected = read(folder, name, GOOD[name])
    if isinstance(GOOD[name], str):
        for changed in (GOOD[name].replace("\n", "\r\n"), GOOD[name].replace("\n", " \n") + "\n\n"):
            assert str(read(folder, name, changed)) == str(expected)


@pytest.mark.parametrize("name", GOOD)
def test_a_file_that_ends_early_is_no_crash(name, folder):
    """Any beginning of a file is read or refused in a sentence that names it."""
    for length in range(0, len(GOOD[name]), 1 + len(GOOD[name]) // 40):
        try:
            read(folder, name, GOOD[name][:length])
        except ValueError as error:
            assert name in str(error)  # noqa: PT017
