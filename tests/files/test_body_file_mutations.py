"""One change of a good file each, with its decided result: read as before, or one sentence with file and line."""

import data_files
import pytest

from lieint_jax import files, shapes

SAMPLES = sorted((data_files.FOLDER / "samples" / "bodies").iterdir())
GOOD = {path.name: path.read_bytes() if path.name[0] == "b" else path.read_text(encoding="utf-8") for path in SAMPLES}


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
MUTATIONS = [  # and two of thousands of characters
    *data_files.table("body_file_mutations")["rows"],
    ["a.obj", "f 1 2 4\n", f"f 1 2 {'9' * 5000}\n", "line 9: a face must have indices .* got '9{200}…'"],
    ["lc.json", "[", "[" * 100_000, "this is no JSON"],
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("mutated")


def read(folder, name, data):
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return READERS.get(name, triangles)(path)


@pytest.mark.parametrize(("name", "old", "new", "result"), MUTATIONS, ids=range(len(MUTATIONS)))
def test_a_changed_file(name, old, new, result, folder):
    if isinstance(GOOD[name], bytes):
        old, new = old.encode("latin-1"), new.encode("latin-1")
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
