"""Surfaces of triangles from files, and what is wrong with them, by the lines of the file."""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._text import Text, decode, read_bytes
from lieint_jax.shapes._solids import Shape, largest_coordinate, mesh

__all__ = ["ENDINGS", "obj", "surface"]

_AT_ONCE = 2**16  # lines of a table that are converted together
_BINARY_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_PLY_TYPES = {
    name: code
    for code, names in {
        "b": "char int8", "B": "uchar uint8", "h": "short int16", "H": "ushort uint16", "i": "int int32",
        "I": "uint uint32", "f": "float float32", "d": "double float64",
    }.items()
    for name in names.split()
}  # fmt: skip


def obj(
    path: str | Path, *, mass: ArrayLike | None = None, density: ArrayLike | None = None, scale: float = 1.0
) -> Shape:
    """The homogeneous polyhedron of a Wavefront OBJ file, as planetary archives distribute shapes of asteroids.

    Polygons are cut into triangles, and vertices that are written twice are merged. `files.read_shape` reads other
    formats too.

    Args:
        path: the path of the file.
        mass, density: exactly one of them, a scalar; a density refers to the unit of length after scaling.
        scale: the factor from the file's unit of length to yours: 1000 from km to m.

    Raises:
        ValueError: the file has no vertices or no faces, or a line that is not OBJ; the surface is not closed or faces
            differ in orientation, with the lines of these faces; and the errors of `shapes.mesh`.
    """
    vertices, faces = _merge(_read_obj(str(path), read_bytes(path)), closed=True)
    _checks.one_of(mass=mass, density=density)
    try:
        return mesh(scale * vertices, faces, mass=mass, density=density)
    except ValueError as error:
        raise ValueError(f"{_checks.path_text(path)}: {error}") from error


def surface(path: str | Path, *, closed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of a file, for `mesh`, `facets` or to draw.

    | ending | format |
    |---|---|
    | .obj | Wavefront; polygons are cut into triangles |
    | .stl | in text or binary |
    | .ply | in text or binary, of either byte order |
    | .txt | shape.txt of DAMIT: the numbers of vertices and faces, rows of vertices, rows of faces |
    | .tab | plate models of the PDS: as DAMIT's; rows `v x y z` and `f i j k`; Gaskell's "ver", a number of rows that \
are numbered, twice. Not: "quad" models (ICQ), grids of radii |

    Rows of numbers may themselves be numbered. In a .tab or .txt, indices are counted from 0 if one of them is 0.

    Args:
        path: a path that ends in one of these, or in one of these and .gz.
        closed: whether to raise an error if the surface is not closed or its faces differ in orientation, with the
            lines of these faces: `mesh` would name their vertices, as they are numbered here.

    Returns:
        The vertices (V, 3), those at one place merged, and the indices of the vertices of each triangle, (F, 3).
        Triangles with two vertices at one place are left out: the others still meet where they were.

    Raises:
        ValueError: another ending, no triangles, or a line of another format.
    """
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    reader = _READERS.get(["", *suffixes][-2 if suffixes[-1:] == [".gz"] else -1])
    if reader is None:
        raise ValueError(
            f"a surface is read from a file {', '.join(ENDINGS)}, each also with .gz, got {_checks.path_text(path)}; "
            "files.read_shape "
            "reads other formats with trimesh"
        )
    return _merge(reader(str(path), read_bytes(path)), closed)


class _Triangles(NamedTuple):
    """The triangles as a file has them.

    Attributes:
        text: the file's name, for messages.
        vertices: (V, 3).
        faces: (F, 3), counted from 0.
        lines: the line of each face, (F,), or its number from 1 in a binary file.
        word: "line" or "face", accordingly.
        base: the number of the first vertex in the file.
    """

    text: Text
    vertices: np.ndarray
    faces: np.ndarray
    lines: np.ndarray
    word: str = "line"
    base: int = 0

    def fail(self, k: int, what: str) -> NoReturn:
        raise ValueError(f"{self.text.name}, {self.word} {self.lines[k]}: {what}")


def _merge(found: _Triangles, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """The vertices and triangles, vertices at one place merged."""
    vertices, faces, base = found.vertices, found.faces, found.base
    if not len(vertices) or not len(faces):
        found.text.fail(0, f"there must be vertices and faces, got {len(vertices)} and {len(faces)}")
    wrong = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
    if len(wrong):
        allowed, got = f"{base} to {len(vertices) - 1 + base}", (faces[wrong[0]] + base).tolist()
        found.fail(wrong[0], f"a face must have indices of vertices, from {allowed}, got {got}")
    most = largest_coordinate(float)
    wrong = np.flatnonzero(~(np.abs(vertices[faces]) < most).all(axis=(1, 2)))
    if len(wrong):
        found.fail(wrong[0], f"a vertex of this face is not finite, or beyond {most:.3g}: moments would overflow")
    places, merged = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # −0 is 0
    F = merged.reshape(-1)[faces]
    whole = (F[:, 0] != F[:, 1]) & (F[:, 1] != F[:, 2]) & (F[:, 2] != F[:, 0])
    if not whole.any():
        found.text.fail(0, "no face has its three vertices at different places")
    if closed:
        _check_closed(found._replace(vertices=places, faces=F[whole], lines=found.lines[whole]))
    return places, F[whole]


def _check_closed(found: _Triangles) -> None:
    """ValueError, with the lines of faces, unless each edge belongs to two faces, which run along it in opposition."""
    F, count = found.faces.astype(np.int64), len(found.vertices)
    a, b = F.ravel(), np.roll(F, -1, axis=1).ravel()  # edge k of face k // 3
    keys, opposite = a * count + b, b * count + a
    names, uses = np.unique(keys, return_counts=True)
    double = np.isin(keys, names[uses > 1])
    if double.any():
        worst = int(np.argmax(np.bincount(np.arange(3 * len(F))[double] // 3)))  # probably the one that is wrong
        key = keys[3 * worst : 3 * worst + 3][double[3 * worst : 3 * worst + 3]][0]
        along, against = np.flatnonzero(keys == key) // 3, np.flatnonzero(opposite == key) // 3
        _check_copies(found, np.concatenate([along, against]))
        other = f"{found.word} {found.lines[along[along != worst][0]]}"
        if len(along) == len(against):
            found.fail(worst, f"{2 * len(along)} faces, also that of {other}, meet in one edge: separate the parts")
        found.fail(
            worst,
            f"this face and that of {other} run along their common edge in the same direction: reverse one of them, "
            "all must be oriented alike",
        )
    alone = np.flatnonzero(~np.isin(keys, opposite))
    if len(alone):
        ends = " to ".join(str(found.vertices[end[alone[0]]].tolist()) for end in (a, b))
        found.fail(
            alone[0] // 3,
            f"the surface must be closed, but {len(alone)} edges belong to one face only, such as that of this face "
            f"from {ends}: close the holes",
        )


def _check_copies(found: _Triangles, some: np.ndarray) -> None:
    """ValueError if two of these faces have the same vertices."""
    seen: dict[tuple[int, ...], int] = {}
    for k in np.unique(some).tolist():
        first = seen.setdefault(tuple(sorted(found.faces[k].tolist())), k)
        if first != k:
            found.fail(k, f"this is the face of {found.word} {found.lines[first]} again: leave one of them out")


def _text(name: str, data: bytes) -> Text:
    """The lines of a file, whose comments may be in Latin-1."""
    try:
        return decode(name, data)
    except ValueError:
        if b"\0" in data:
            raise
        return decode(name, data.decode("latin-1").encode())


def _fan(corners: Sequence[int]) -> list[list[int]]:
    """The triangles of a polygon."""
    return [[corners[0], b, c] for b, c in itertools.pairwise(corners[1:])]


def _triangles(
    text: Text, vertices: object, faces: list[list[int]], lines: list[int], word: str = "line", base: int = 0
) -> _Triangles:
    at, F = np.array(vertices, float).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
    return _Triangles(text, at, F, np.array(lines, np.int64), word, base)


def _read_obj(name: str, data: bytes) -> _Triangles:
    text = _text(name, data)
    at: list[int] = []  # the lines of the vertices
    rows, faces, lines = [], [], []
    for number, line in enumerate(text.lines, 1):
        kind, *words = line.split("#")[0].split() or [""]
        if kind not in ("v", "f"):
            continue
        if len(words) < 3:
            text.fail(number, f"{'a vertex' if kind == 'v' else 'a face'} needs three numbers, got {_show(line)}")
        if kind == "v":
            if len(words) == 4 and text.number(number, words[3], "the weight of a vertex") != 1:
                text.fail(number, f"the weight w of a vertex x y z w must be 1, got {_show(words[3])}")
            at.append(number)
            rows.append(words[:3])
            continue
        faces += _fan([_obj_index(text, number, word, len(at)) for word in words])
        lines += [number] * (len(words) - 2)
    return _triangles(text, _convert(text, at, rows, "a coordinate"), faces, lines, base=1)


def _obj_index(text: Text, number: int, word: str, count: int) -> int:
    """The vertex of a corner "7", "7/1/1" or "−2", counted from 0; `count` vertices are above it."""
    try:
        k = int(word.partition("/")[0])
    except ValueError:
        k = 0
    if not -count <= k < 2**53 or k == 0 or "_" in word:
        text.fail(
            number, f"a face must have indices of vertices, from 1, or from −1 back to −{count}, got {_show(word)}"
        )
    return k - 1 if k > 0 else count + k


def _show(value: object) -> str:
    return repr(_checks.printable(value))


def _read_stl(name: str, data: bytes) -> _Triangles:
    if b"\0" in data[:84]:  # the number of triangles has one
        count, rest = int.from_bytes(data[80:84], "little"), len(data) - 84
        if rest != count * _BINARY_STL.itemsize:
            Text(name, []).fail(0, f"{count} triangles of 50 bytes must follow the header of 84, got {rest} bytes")
        corners = np.frombuffer(data, _BINARY_STL, offset=84)["corners"].astype(float).reshape(-1, 3)
        return _separate(Text(name, []), corners, np.arange(1, count + 1), "face")
    text, corners, at, lines, open_since = _text(name, data), [], [], [], 0
    for number, line in enumerate(text.lines, 1):
        words = line.lower().split()
        if words[:1] == ["vertex"]:
            if len(words) != 4:
                text.fail(number, f"a vertex needs three numbers, got {_show(line)}")
            corners.append(words[1:])
            at.append(number)
        elif words[:1] == ["outer"]:
            open_since = number
            lines.append(number)
        elif words[:1] == ["endloop"]:
            open_since = 0
            if len(corners) != 3 * len(lines):
                text.fail(number, "a facet needs three vertices between outer loop and endloop")
    if open_since or len(corners) != 3 * len(lines):
        text.fail(open_since, "a facet is not finished: the file must have facets of outer loop, 3 vertices, endloop")
    return _separate(text, _convert(text, at, corners, "a coordinate").reshape(-1, 3), np.array(lines, int), "line")


def _separate(text: Text, corners: np.ndarray, lines: np.ndarray, word: str) -> _Triangles:
    """Triangles that share no vertices."""
    return _Triangles(text, corners, np.arange(len(corners)).reshape(-1, 3), lines, word)


def _read_tables(name: str, data: bytes) -> _Triangles:
    """Rows of vertices and of faces, after a line with both their numbers, or each after a line with its number."""
    text = _text(name, data)
    at = [number for number, line in enumerate(text.lines, 1) if line.strip()]
    if any(text.lines[k - 1].split(None, 1)[0] == "v" for k in at):
        return _read_obj(name, data)
    first = _split(text, at[0]) if at else []
    if len(first) == 2:
        count, faces = (_count(text, at[0], word) for word in first)
        middle = 1 + count
    elif len(first) == 1 and len(at) > 2 and len(_split(text, at[1])) == 4:  # with 3 it is a model of quadrilaterals
        count = _count(text, at[0], first[0])
        middle = 2 + count
        faces = _count(text, at[middle - 1], text.lines[at[middle - 1] - 1].strip()) if middle <= len(at) else 0
    else:
        text.fail(
            at[0] if at else 0,
            "a plate model must begin with the numbers of vertices and faces, or with the number of vertices and rows "
            "that are numbered; quadrilaterals (ICQ) and grids of radii are not read: take the archive's plate model",
        )
    if len(at) != middle + faces:
        text.fail(at[0], f"{count} vertices and {faces} faces must follow, got {len(at)} lines in all")
    vertices, corners = _table(text, at[1 : 1 + count], "a vertex"), _table(text, at[middle:], "a face")
    lines = np.array(at[middle:])
    wrong = np.flatnonzero((corners != np.rint(corners)).any(axis=1) | (np.abs(corners) > 2**53).any(axis=1))
    if len(wrong):
        text.fail(int(lines[wrong[0]]), f"the indices of a face must be integers, got {corners[wrong[0]].tolist()}")
    indices = corners.astype(np.int64)
    base = 0 if (indices == 0).any() else 1
    if len(indices) and base == 1 and indices.max() < count:
        text.fail(0, f"no face has vertex 0 or {count}: it cannot be told whether indices are counted from 0 or 1")
    return _Triangles(text, vertices, indices - base, lines, base=base)


def _split(text: Text, number: int) -> list[str]:
    return text.lines[number - 1].replace(",", " ").split()


def _count(text: Text, number: int, word: str) -> int:
    if not re.fullmatch(r"\d{1,9}", word):
        text.fail(number, f"a number of vertices or faces must be an integer, got {_show(word)}")
    return int(word)


def _table(text: Text, at: Sequence[int], what: str) -> np.ndarray:
    """The three numbers of each of these lines, or the last three of lines that are numbered."""
    columns = 4 if at and len(_split(text, at[0])) == 4 else 3
    parts = [np.empty((0, columns))]
    for first in range(0, len(at), _AT_ONCE):
        some = at[first : first + _AT_ONCE]
        rows = [_split(text, number) for number in some]
        for number, row in zip(some, rows, strict=True):
            if len(row) != columns:
                text.fail(number, f"{what} needs {columns} numbers, as in the lines above, got {_show(' '.join(row))}")
        parts.append(_convert(text, some, rows, what))
    table = np.concatenate(parts)
    if columns == 4:
        wrong = np.flatnonzero(np.diff(table[:, 0]) != 1)
        if len(wrong) or table[0, 0] not in (0, 1):
            text.fail(at[wrong[0] + 1 if len(wrong) else 0], "rows of four numbers must be numbered from 0 or 1")
    return table[:, -3:]


def _convert(text: Text, at: Sequence[int], rows: list[list[str]], what: str) -> np.ndarray:
    """The finite numbers in rows of equal length, of these lines: together, and one by one if some need care."""
    try:
        table = np.array(rows, float)
    except ValueError:  # an exponent of D, or no number
        table = np.full(1, np.nan)
    if np.isfinite(table).all() and not any("_" in word for row in rows for word in row):
        return table
    return np.array([text.numbers(number, row, what) for number, row in zip(at, rows, strict=True)])


_Row = tuple[str, int, dict[str, Sequence[float]]]  # element, its line or number from 1, its properties


class _Element(NamedTuple):
    """An element of a PLY file: its properties are (name, code, code of the length of a list or "")."""

    name: str
    size: int
    properties: list[tuple[str, str, str]]


def _read_ply(name: str, data: bytes) -> _Triangles:
    """The elements "vertex" and "face" of a PLY file."""
    found = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data)
    head = _text(name, data[: found.end()] if found else data[:200])
    if not found or head.lines[0].strip() != "ply":
        head.fail(1, 'a PLY file must begin with a line "ply" and have a line "end_header"')
    form, elements = _ply_header(head)
    if form == "ascii":
        text, word = _text(name, data), "line"
        rows = _text_rows(text, elements, len(head.lines))
    else:
        text, word = Text(name, []), "face"
        rows = _binary_rows(text, elements, data[found.end() :], "<" if form == "binary_little_endian" else ">")
    vertices, faces, lines = [], [], []
    for kind, place, row in rows:
        if kind == "vertex":
            vertices.append([row[x][0] for x in "xyz"])
        elif kind == "face":
            corners = row.get("vertex_indices", row.get("vertex_index", ()))
            if len(corners) < 3 or not all(float(x).is_integer() and abs(x) < 2**53 for x in corners):
                what = f"{word} {place}: a face needs a list vertex_indices of three or more integers"
                raise ValueError(f"{text.name}, {what}, got {_show(list(corners))}")
            faces += _fan([int(x) for x in corners])
            lines += [place] * (len(corners) - 2)
    return _triangles(text, vertices, faces, lines, word)


def _ply_header(head: Text) -> tuple[str, list[_Element]]:
    form, elements = "", []
    for number, line in enumerate(head.lines, 1):
        match line.split():
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, "1.0"]:
                pass
            case ["element", name, count]:
                elements.append(_Element(name, _count(head, number, count), []))
            case ["property", kind, name] if kind in _PLY_TYPES and elements:
                elements[-1].properties.append((name, _PLY_TYPES[kind], ""))
            case ["property", "list", length, kind, name] if (
                kind in _PLY_TYPES and _PLY_TYPES.get(length, "f") not in "fd" and elements
            ):
                elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case [] | ["ply" | "comment" | "obj_info" | "end_header", *_]:
                pass
            case _:
                head.fail(number, f"no line of the header of a PLY file: {_show(line)}")
    for element in elements:
        names = [name for name, _, length in element.properties if not length]
        if element.name == "vertex" and not ({"x", "y", "z"} <= set(names) and len(names) == len(element.properties)):
            head.fail(0, "the element vertex must have properties x, y and z and no lists")
        if not element.properties:
            head.fail(0, f"the element {_checks.printable(element.name)} has no properties")
    names = [element.name for element in elements]
    if not form or names.count("vertex") != 1 or names.count("face") != 1:
        head.fail(0, "the header must state the format, one element vertex and one element face")
    return form, elements


def _text_rows(text: Text, elements: list[_Element], head: int) -> Iterator[_Row]:
    """The rows of elements in lines of text, after a header of so many lines."""
    at = [number for number, line in enumerate(text.lines, 1) if line.strip() and number >= head]
    if len(at) != (count := sum(element.size for element in elements)):
        text.fail(0, f"{count} lines of elements must follow the header, got {len(at)}")
    kinds = [element for element in elements for _ in range(element.size)]
    for number, (kind, _, properties) in zip(at, kinds, strict=True):
        words, row = text.lines[number - 1].split(), {}
        for name, _, length in properties:
            count = _count(text, number, words.pop(0) if words else "") if length else 1
            row[name] = text.numbers(number, words[:count], f"the property {_checks.printable(name)}")
            if len(row[name]) != count:
                text.fail(number, f"the line has too few numbers: {_show(text.lines[number - 1])}")
            words = words[count:]
        if words:
            text.fail(number, f"the line has too many numbers: {_show(text.lines[number - 1])}")
        yield kind, number, row


def _binary_rows(text: Text, elements: list[_Element], data: bytes, order: str) -> Iterator[_Row]:
    offset = 0
    for kind, size, properties in elements:
        for k in range(1, size + 1):
            row = {}
            try:
                for name, code, length in properties:
                    count = struct.unpack_from(order + length, data, offset)[0] if length else 1
                    offset += struct.calcsize(length) if length else 0
                    row[name] = struct.unpack_from(f"{order}{count}{code}", data, offset)
                    offset += count * struct.calcsize(code)
            except struct.error:
                text.fail(0, f"the file ends in element {_checks.printable(kind)} {k} of {size}")
            yield kind, k, row
    if offset != len(data):
        text.fail(0, f"{offset} bytes must follow the header, got {len(data)}")


_READERS: dict[str, Callable[[str, bytes], _Triangles]] = {
    ".obj": _read_obj,
    ".stl": _read_stl,
    ".ply": _read_ply,
    ".txt": _read_tables,
    ".tab": _read_tables,
}
ENDINGS = tuple(_READERS)
