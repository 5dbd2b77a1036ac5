"""Molecules from files of xyz and PDB, as rigid bodies."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks, shapes
from lieint_jax._text import Text, read_text

__all__ = ["Atoms", "Superposition", "read_molecule", "read_molecules"]

_WEIGHTS = """
H 1.008 He 4.0026 Li 6.94 Be 9.0122 B 10.81 C 12.011 N 14.007 O 15.999 F 18.998 Ne 20.180 Na 22.990 Mg 24.305 Al 26.982
Si 28.085 P 30.974 S 32.06 Cl 35.45 Ar 39.95 K 39.098 Ca 40.078 Sc 44.956 Ti 47.867 V 50.942 Cr 51.996 Mn 54.938
Fe 55.845 Co 58.933 Ni 58.693 Cu 63.546 Zn 65.38 Ga 69.723 Ge 72.630 As 74.922 Se 78.971 Br 79.904 Kr 83.798 Rb 85.468
Sr 87.62 Y 88.906 Zr 91.224 Nb 92.906 Mo 95.95 Tc 97 Ru 101.07 Rh 102.91 Pd 106.42 Ag 107.87 Cd 112.41 In 114.82
Sn 118.71 Sb 121.76 Te 127.60 I 126.90 Xe 131.29 Cs 132.91 Ba 137.33 La 138.91 Ce 140.12 Pr 140.91 Nd 144.24 Pm -
Sm 150.36 Eu 151.96 Gd 157.25 Tb 158.93 Dy 162.50 Ho 164.93 Er 167.26 Tm 168.93 Yb 173.05 Lu 174.97 Hf 178.49 Ta 180.95
W 183.84 Re 186.21 Os 190.23 Ir 192.22 Pt 195.08 Au 196.97 Hg 200.59 Tl 204.38 Pb 207.2 Bi 208.98 Po - At - Rn - Fr -
Ra - Ac - Th 232.04 Pa 231.04 U 238.03 Np - Pu - Am - Cm - Bk - Cf - Es - Fm - Md - No - Lr - Rf - Db - Sg - Bh - Hs -
Mt - Ds - Rg - Cn - Nh - Fl - Mc - Lv - Ts - Og -
"""  # standard atomic weights, IUPAC 2021, abridged, of the elements that have one; of technetium a mass number
_SYMBOLS, _NUMBERS = _WEIGHTS.split()[::2], _WEIGHTS.split()[1::2]
_MASSES = {symbol: float(mass) for symbol, mass in zip(_SYMBOLS, _NUMBERS, strict=True) if mass != "-"}
_MASSES |= {"D": 2.0141, "T": 3.0160}  # the isotopes of hydrogen that have symbols
_RADII_TO_XENON = """
.31 .28 1.28 .96 .84 .76 .71 .66 .57 .58 1.66 1.41 1.21 1.11 1.07 1.05 1.02 1.06 2.03 1.76 1.70 1.60 1.53 1.39 1.61 1.52
1.50 1.24 1.32 1.22 1.22 1.20 1.19 1.20 1.20 1.16 2.20 1.95 1.90 1.75 1.64 1.54 1.47 1.46 1.42 1.39 1.45 1.44 1.42 1.39
1.39 1.38 1.39 1.40
"""  # of covalent bonds in Å, Cordero et al. 2008, Dalton Trans. 2832
_RADII = {symbol: float(radius) for symbol, radius in zip(_SYMBOLS, _RADII_TO_XENON.split(), strict=False)}
_SMALL, _LARGE = 0.31, 1.5  # radii of hydrogen's isotopes and of sites without mass, and of the elements beyond xenon
_BOND = 1.3  # sums of radii below which atoms are bonded: a bond has 1, a hydrogen bond 1.6
_LIGHT = frozenset(_SYMBOLS[:54])  # to xenon
_STRAIGHT = 1e-6  # of the largest second moment: files have three digits after the point


class Superposition(NamedTuple):
    """Where a body is, so that its sites lie on the atoms of a file.

    Attributes:
        attitude: from the axes of the body to those of the file, a unit quaternion (w, x, y, z), (4,).
        position: of the origin of the body's axes, (3,).
        rms: the root of the mean square of the distances that are left, weighted by mass.
    """

    attitude: np.ndarray
    position: np.ndarray
    rms: float


@dataclasses.dataclass(frozen=True)
class Atoms:
    """Atoms that move as one rigid body.

    Attributes:
        names: of the atoms, as in the file.
        elements: their symbols.
        positions: (n, 3), in Å times the `scale` of the reader.
        masses: (n,), in u.
    """

    names: tuple[str, ...]
    elements: tuple[str, ...]
    positions: np.ndarray
    masses: np.ndarray

    def shape(self, *, axial_moment: float | None = None) -> shapes.Shape:
        """The shape of these point masses, in the axes of the file.

        Args:
            axial_moment: of a straight molecule (CO₂, N₂), which has no moment of inertia about its axis: the small one
                with which `systems.rigid_bodies` can rotate it. The others stay as they are.

        Raises:
            ValueError: an axial moment is given that is not positive, or the molecule is not straight.
        """
        found = shapes.sites(self.masses, self.positions)
        if axial_moment is None:
            return found
        squares, axes = np.linalg.eigh(np.asarray(found.second, float))
        if not squares[1] <= _STRAIGHT * squares[2]:
            raise ValueError(f"axial_moment is that of a straight molecule, but this has second moments {squares}")
        along = _checks.positive("axial_moment", axial_moment) * np.outer(axes[:, 2], axes[:, 2])
        across = squares[2] * (np.eye(3) - np.outer(axes[:, 2], axes[:, 2]))
        return shapes.body(mass=found.mass, center=found.center, inertia=across + along)

    def superpose(self, reference: Atoms | ArrayLike) -> Superposition:
        """The attitude and position at which a body lies best on these atoms, by least squares weighted by mass.

        Args:
            reference: the sites of the body in its axes, one for each atom in the same order, (n, 3), in the unit of
                `positions`, such as `potentials.water().points[:3]`; or another molecule, whose axes are those of its
                file with the origin at its center of mass, as of its `shape()`.

        Raises:
            ValueError: another number of sites, or other elements.

        Source: Horn 1987, J. Opt. Soc. Am. A 4, 629. About the axis of a straight molecule any rotation is as good.
        """
        if isinstance(reference, Atoms):
            if reference.elements != self.elements:
                raise ValueError(f"reference must have the elements {self.elements}, got {reference.elements}")
            sites = reference.positions - _mean(reference.masses, reference.positions)
        else:
            sites = np.asarray(_checks.real_array("reference", reference, self.positions.shape), float)
        weights = self.masses / self.masses.sum()
        start, end = _mean(weights, sites), _mean(weights, self.positions)
        r, p = sites - start, self.positions - end
        S = (weights[:, None] * r).T @ p
        about = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
        N = np.block([[np.trace(S), about], [about[:, None], S + S.T - np.trace(S) * np.eye(3)]])
        w, *v = q = np.linalg.eigh(N)[1][:, -1]

        def rotated(x: np.ndarray) -> np.ndarray:
            return x + 2 * np.cross(v, np.cross(v, x) + w * x)

        error = np.sqrt(weights @ ((p - rotated(r)) ** 2).sum(axis=1))
        return Superposition(q if w >= 0 else -q, end - rotated(start), float(error))


def _mean(masses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return masses @ positions / masses.sum()


def read_molecule(path: str | Path, *, masses: Mapping[str, float] | None = None, scale: float = 1.0) -> Atoms:
    """All atoms of a file of xyz or PDB as one rigid molecule, as `read_molecules` reads them.

    Raises:
        ValueError: several frames of xyz, and the errors of `read_molecules`.
    """
    found = read_molecules(path, masses=masses, scale=scale)
    if _ending(path) == ".xyz" and len(found) > 1:
        raise ValueError(
            f"{_checks.path_text(path)} has {len(found)} frames: read_molecules returns a molecule of each"
        )
    return Atoms(
        sum((each.names for each in found), ()),
        sum((each.elements for each in found), ()),
        np.concatenate([each.positions for each in found]),
        np.concatenate([each.masses for each in found]),
    )


def read_molecules(path: str | Path, *, masses: Mapping[str, float] | None = None, scale: float = 1.0) -> list[Atoms]:
    """The molecules of a file: each residue of a PDB, each frame of an xyz.

    Of a PDB the first model is read, and of atoms with alternate locations the first one. A residue whose names repeat
    without a bond from one turn to the next is as many molecules, such as waters that all have one number. An element
    that the file does not state is taken from the columns of the atom's name. Of extended xyz the columns are those of
    Properties, and masses are read; what follows the atoms in files of QM9 is skipped.

    Args:
        path: a path that ends in .xyz, .pdb or .ent, or in one of these and .gz.
        masses: in u, by names of atoms or symbols of elements, in place of the standard atomic weights: {"MW":
            0.0} for a site without mass, {"H": 2.014} for heavy water; D and T are known.
        scale: the factor from Å, the unit of these files, to your unit of length: 0.1 for nm.

    Raises:
        ValueError: another ending, a line that is wrong, an element without a mass, or a file that ends too early.
    """
    ending, factor = _ending(path), float(_checks.positive("scale", scale))
    if ending not in (".xyz", ".pdb", ".ent"):
        raise ValueError(
            f"molecules are read from .xyz, .pdb and .ent, each also with .gz, got {_checks.path_text(path)}"
        )
    text = read_text(path)
    groups = list(_xyz_frames(text) if ending == ".xyz" else _pdb_molecules(text))
    if not groups:
        text.fail(0, "there are no atoms")
    return [_atoms(text, rows, masses or {}, factor) for rows in groups]


class _Row(NamedTuple):
    line: int
    name: str
    element: str
    position: list[float]
    mass: float | None = None  # in u, where the file has it


def _ending(path: str | Path) -> str:
    return Path(str(path).lower().removesuffix(".gz")).suffix


def _atoms(text: Text, rows: list[_Row], masses: Mapping[str, float], scale: float) -> Atoms:
    weights = []
    for line, name, element, _, own in rows:
        mass = masses.get(name, masses.get(element, _MASSES.get(element) if own is None else own))
        if mass is None:
            text.fail(
                line, f"no mass is known of {_checks.printable(element or name)!r}: give it as masses={{NAME: mass}}"
            )
        weights.append(float(_checks.not_negative(f"the mass of {name}", mass)))
    if not sum(weights) > 0:
        text.fail(rows[0].line, "the molecule that begins here has no mass")
    _, names, elements, positions, _ = zip(*rows, strict=True)
    return Atoms(names, elements, scale * np.array(positions), np.array(weights))


def _xyz_frames(text: Text) -> Iterator[list[_Row]]:
    """The atoms of each frame: a line with their number, a comment, a line for each."""
    line, last = 1, len(text.lines)
    while line <= last:
        if not (first := text.lines[line - 1].strip()):
            line += 1
            continue
        if not re.fullmatch(r"\d{1,9}", first) or int(first) == 0:
            text.fail(line, f"a frame of xyz begins with the number of its atoms, got {_checks.printable(first)!r}")
        end = line + 2 + int(first)
        if end > last + 1:
            text.fail(line, f"{first} atoms must follow a line of comment, but the file ends at line {last}")
        columns = _xyz_columns(text, line + 1)
        yield [_xyz_row(text, k, columns) for k in range(line + 2, end)]
        if text.lines[line].split()[:1] == ["gdb"]:  # of QM9: frequencies, SMILES and InChI follow
            last_of_frame = [k for k in range(end, min(end + 3, last + 1)) if text.lines[k - 1].startswith("InChI=")]
            end = last_of_frame[0] + 1 if last_of_frame else end
        line = end


class _Columns(NamedTuple):
    """The first columns of the element, the position and the mass of an atom, counted from 0."""

    element: int = 0
    position: int = 1
    mass: int | None = None


def _xyz_columns(text: Text, line: int) -> _Columns:
    """The columns that a line of comment names (extended xyz), by default an element and its position."""
    given = re.search(r"\bProperties\s*=\s*(\"?)([^\"\s]*)\1", text.lines[line - 1], re.IGNORECASE)
    if given is None:
        return _Columns()
    words = given[2].split(":")
    places: dict[str, tuple[str, int]] = {}
    at = 0
    for name, kind, count in zip(words[::3], words[1::3], words[2::3], strict=False):
        if kind not in ("S", "R", "I", "L") or not re.fullmatch(r"[1-9]\d{0,3}", count):
            break
        places[name.lower()] = f"{kind}:{count}", at
        at += int(count)
    element = next((places[name] for name in ("species", "element", "symbol", "symbols", "z") if name in places), None)
    mass = next((places[name] for name in ("mass", "masses") if name in places), ("R:1", None))
    position = places.get("pos", ("", 0))
    if (
        len(words) % 3
        or element is None
        or element[0] not in ("S:1", "I:1")
        or position[0] != "R:3"
        or mass[0] != "R:1"
    ):
        shown = _checks.printable(given[2])
        text.fail(line, f"Properties of extended xyz must have species:S:1 and pos:R:3, in any order, got {shown!r}")
    return _Columns(element[1], position[1], mass[1])


def _xyz_row(text: Text, line: int, columns: _Columns) -> _Row:
    words = text.lines[line - 1].split()
    if len(words) <= max(columns.element, columns.position + 2, columns.mass or 0):
        text.fail(
            line, f"an atom needs an element and three coordinates, got {_checks.printable(text.lines[line - 1])!r}"
        )
    name = words[columns.element]
    if name.isdecimal() and 0 < int(name[:9]) <= len(_SYMBOLS):
        element = _SYMBOLS[int(name) - 1]
    else:
        element = _symbol(re.sub(r"[^A-Za-z].*", "", name))
    at = text.numbers(line, words[columns.position : columns.position + 3], "a coordinate")
    mass = None if columns.mass is None else text.number(line, words[columns.mass], "a mass")
    return _Row(line, name, element, at, mass)


def _symbol(letters: str) -> str:
    """The element of a label: its first two letters if that is one, else its first, as written.

    Beyond xenon they must be written as the symbol, Pt: PT may be a phosphorus too, and is returned as it is.
    """
    two, one = letters[:2].capitalize(), letters[:1].upper()
    if two in _LIGHT or two not in _SYMBOLS:
        return two if two in _LIGHT or one not in _LIGHT else one
    return letters[:2]


def _pdb_molecules(text: Text) -> Iterator[list[_Row]]:
    """The atoms of each residue, or of each molecule of one that has the number of several."""
    for rows in _pdb_residues(text):
        names, count = [row.name for row in rows], len(rows)
        turn = next(k for k in range(1, count + 1) if count % k == 0 and names == names[:k] * (count // k))
        parts = [rows[k : k + turn] for k in range(0, count, turn)]
        yield from [rows] if any(itertools.starmap(_are_bonded, itertools.pairwise(parts))) else parts


def _are_bonded(a: list[_Row], b: list[_Row]) -> bool:
    """Whether an atom of one group is bonded to one of the other, by the sum of their covalent radii."""
    positions = [np.array([row.position for row in rows]) for rows in (a, b)]
    radii = [np.array([_radius(row.element) for row in rows]) for rows in (a, b)]
    distances = np.linalg.norm(positions[0][:, None] - positions[1], axis=2)
    return bool((distances < _BOND * (radii[0][:, None] + radii[1])).any())


def _radius(element: str) -> float:
    return _RADII.get(element, _LARGE if element in _MASSES and element not in ("D", "T") else _SMALL)


def _pdb_residues(text: Text) -> Iterator[list[_Row]]:
    """The atoms of each residue: rows with one chain, number and insertion code, up to TER."""
    rows: list[_Row] = []
    first = ("", "", "")  # of the residue's first atom: chain, number and code; name of the residue; alternate location
    places: dict[str, str] = {}  # the alternate location of each name in the residue
    for number, line in enumerate(text.lines, 1):
        record = line[:6].rstrip().upper()
        if record[:3] == "TER" or record in ("ENDMDL", "END"):
            if rows:
                yield rows
            rows, first, places = [], ("", "", ""), {}
            if record[:3] != "TER":
                return
        if record[:4] != "ATOM" and record != "HETATM":  # serial numbers from 100 000 begin in column 6
            continue
        if len(line) < 54:
            text.fail(number, f"an atom needs coordinates in columns 31 to 54, got {_checks.printable(line)!r}")
        here = line[21:27], line[17:21], line[16]
        if here[0] == first[0] and here[1] != first[1] and " " not in (here[2], first[2]):
            continue  # of another residue, which is an alternate of this one
        if here[:2] != first[:2]:
            if rows:
                yield rows
            rows, first, places = [], here, {}
        name = line[12:16].strip()
        if places.setdefault(name, line[16]) != line[16]:
            continue
        at = text.numbers(number, (line[k : k + 8] for k in (30, 38, 46)), "a coordinate")
        rows.append(_Row(number, name, _pdb_element(line), at))
    if rows:
        yield rows


def _pdb_element(line: str) -> str:
    """Columns 77 and 78, or what the name in columns 13 to 16 says: symbols end in column 14."""
    if stated := line[76:78].strip():
        return stated.capitalize()
    letters = re.sub(r"[^A-Za-z]", "", line[12:14])
    if line[12:13] == "H" and len(line[12:16].strip()) == 4:
        return "H"
    return _symbol(letters if line[12].isalpha() else letters[-1:])
