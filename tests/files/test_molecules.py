"""Molecules of xyz and PDB: positions and attitudes again, and the energy of a dimer as a plain sum over sites."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import files

WATER = li.potentials.water()


def pdb_atom(number, name, residue, at, element="", chain="A", alternate=" ", kind="HETATM", kind_name="HOH"):
    x, y, z = at
    return (
        f"{kind:6}{number:5} {name:4}{alternate}{kind_name:3} {chain}{residue:4}    {x:8.3f}{y:8.3f}{z:8.3f}"
        f"{1.0:6.2f}{0.0:6.2f}          {element:>2}\n"
    )


def dimer(path, poses):
    """Water molecules with O, H, H of the model at these poses, in Å, to three digits as in any PDB."""
    text, number = "REMARK a dimer\n", 0
    for residue, (x, R) in enumerate(poses, 1):
        for name, r in zip((" O  ", " H1 ", " H2 "), WATER.points[:3], strict=True):
            number += 1
            text += pdb_atom(number, name, residue, 10 * (x + R @ r), name[1])
    path.write_text(text + "END\n")
    return path


def site_energy(sites):
    """Coulomb and Lennard-Jones over pairs of sites of two molecules, kJ/mol, by loops."""
    energy = 0.0
    for p, q1, well, size in zip(sites[0], WATER.charges, WATER.wells, WATER.sizes, strict=True):
        for r, q2, other_well, other_size in zip(sites[1], WATER.charges, WATER.wells, WATER.sizes, strict=True):
            d = np.linalg.norm(p - r)
            energy += 138.935458 * q1 * q2 / d
            if well and other_well:
                energy += 4 * well * ((size / d) ** 12 - (other_size / d) ** 6)
    return energy


def test_a_dimer_in_a_pdb_has_the_energy_of_its_sites(tmp_path):
    """The sum over sites at the poses themselves; digits that the file lacks, 0.0005 Å, are 2e-4 of the energy."""
    R = Rotation.from_euler("zyx", [[0.3, 1.2, -0.4], [2.0, -0.5, 0.9]]).as_matrix()
    poses = [(np.array([0.1, 0.2, -0.1]), R[0]), (np.array([0.35, 0.3, 0.05]), R[1])]
    found = files.read_molecules(dimer(tmp_path / "dimer.pdb", poses), scale=0.1)
    placed = [molecule.superpose(WATER.points[:3]) for molecule in found]
    for (x, matrix), pose in zip(poses, placed, strict=True):
        np.testing.assert_allclose(pose.position, x, rtol=0, atol=1e-4)
        w, *v = pose.attitude
        assert (Rotation.from_quat([*v, w]) * Rotation.from_matrix(matrix).inv()).magnitude() < 2e-3
        assert pose.rms < 1e-4
    system = li.systems.rigid_bodies([WATER.mass] * 2, [WATER.inertia] * 2, WATER.potential(2))
    state = system.state([p.position for p in placed], [p.attitude for p in placed])
    q = np.asarray(state.q)
    turned = Rotation.from_quat(np.roll(q[:, 3:], -1, axis=1))
    sites = [x + R.apply(WATER.points) for x, R in zip(q[:, :3], turned, strict=True)]
    energy = float(system.potential_energy(jnp.asarray(q)))
    assert energy == pytest.approx(site_energy(sites), rel=1e-6)  # of Coulomb's constant, which has nine digits


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(3, 7))
def test_superposition_is_that_of_scipy(seed, n):
    rng = np.random.default_rng(seed)
    masses, r, p = rng.uniform(0.5, 20, n), rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    atoms = files.Atoms(("X",) * n, ("X",) * n, p, masses)
    found = atoms.superpose(r)
    mean = masses @ r / masses.sum(), masses @ p / masses.sum()
    R, distance = Rotation.align_vectors(p - mean[1], r - mean[0], weights=masses)
    w, *v = found.attitude
    np.testing.assert_allclose(Rotation.from_quat([*v, w]).as_matrix(), R.as_matrix(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.position, mean[1] - R.apply(mean[0]), rtol=0, atol=1e-9)
    assert found.rms == pytest.approx(distance / np.sqrt(masses.sum()), rel=1e-9)


def test_frames_of_xyz_and_their_shapes(tmp_path):
    path = tmp_path / "two.xyz"
    first = "3\nProperties=species:S:1:pos:R:3:forces:R:3 pbc\nO 0 0 0 1 2 3\nH1 0.9 0.1 0\n1 -0.3 0.8 0.1\n"
    path.write_text(first + "\n3\n\nO 1 2 3\nH 1.9 2.1 3\nH 0.7 2.8 3.1\n\n\n")
    one, two = files.read_molecules(path, masses={"H": 2.014})
    assert one.elements == two.elements == ("O", "H", "H")
    assert one.names == ("O", "H1", "1")
    np.testing.assert_allclose(one.masses, [15.999, 2.014, 2.014], rtol=1e-15)
    pose = two.superpose(one)
    np.testing.assert_allclose(pose.attitude, [1, 0, 0, 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(pose.position, one.shape().center + np.array([1.0, 2, 3]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.shape().inertia, two.shape().inertia, rtol=0, atol=5e-15)
    with pytest.raises(ValueError, match=r"two\.xyz has 2 frames: read_molecules"):
        files.read_molecule(path)
    with pytest.raises(ValueError, match=r"reference must have the elements .*, got \('O', 'O', 'O'\)"):
        one.superpose(files.Atoms(one.names, ("O",) * 3, one.positions, one.masses))


def test_heavy_atoms_are_not_their_first_letters(tmp_path):
    """Platinum has the mass of platinum, not that of phosphorus; what may be either is refused."""
    path, heavy = (
        tmp_path / "heavy.xyz",
        {"Pt": 195.08, "Pb1": 207.2, "Hg": 200.59, "Ir": 192.22, "Cs": 132.91, "W": 183.84},
    )
    path.write_text("7\n\n" + "".join(f"{name} {k} 0 0\n" for k, name in enumerate([*heavy, "80"])))
    found = files.read_molecule(path)
    np.testing.assert_array_equal(found.masses, [*heavy.values(), 200.59])
    assert found.elements == ("Pt", "Pb", "Hg", "Ir", "Cs", "W", "Hg")
    for name, shown in {"PT": "PT", "HG11": "HG", "Po": "Po", "Cm": "Cm", "WAT": "Wa", "94": "Pu"}.items():
        path.write_text(f"1\n\n{name} 0 0 0\n")
        with pytest.raises(ValueError, match=rf"line 3: no mass is known of '{shown}': give it as masses="):
            files.read_molecule(path)
        assert files.read_molecule(path, masses={name: 1.5}).masses.tolist() == [1.5]


def test_residues_alternate_locations_models_and_names_of_pdb(tmp_path):
    at = np.arange(12.0).reshape(4, 3)
    lines = [
        "MODEL        1\n",
        pdb_atom(1, " CA ", 7, at[0], kind="ATOM", kind_name="GLY", alternate="A"),
        pdb_atom(2, " CA ", 7, at[1], kind="ATOM", kind_name="GLY", alternate="B"),
        pdb_atom(3, "HG11", 7, at[1], kind="ATOM", kind_name="GLY"),
        pdb_atom(4, "CA  ", 8, at[2], kind_name=" CA"),
        "TER\n",
        pdb_atom(5, " OW ", 9, at[2], kind_name="SOL"),
        pdb_atom(6, " MW ", 9, at[3], kind_name="SOL"),
        "TER\n",
        pdb_atom(7, " OW ", 9, at[3], kind_name="SOL"),
        "ENDMDL\nMODEL        2\n",
        pdb_atom(1, " CA ", 7, at[3]),
    ]
    path = tmp_path / "a.ent"
    path.write_text("".join(lines))
    found = files.read_molecules(path, masses={"MW": 0.0})
    assert [x.elements for x in found] == [("C", "H"), ("Ca",), ("O", "M"), ("O",)]
    np.testing.assert_array_equal(found[0].positions, at[:2])
    whole = files.read_molecule(path, masses={"MW": 0.0})
    assert len(whole.positions) == 6
    assert float(whole.shape().mass) == pytest.approx(12.011 + 1.008 + 40.078 + 2 * 15.999, rel=1e-14, abs=0)
    with pytest.raises(ValueError, match=r"a\.ent, line 8: no mass is known of 'M': give it as masses="):
        files.read_molecules(path)


def test_a_residue_with_an_alternate_of_another_kind_is_one(tmp_path):
    """As residue 22 of crambin (1EJG), proline or serine: only the first is read. Six digits of serials begin early."""
    at, path = np.arange(15.0).reshape(5, 3), tmp_path / "a.pdb"
    rows = [(" N  ", "PRO", "A"), (" N  ", "SER", "B"), (" CG ", "PRO", "A"), (" OG ", "SER", "B")]
    lines = [pdb_atom(k, name, 22, at[k], kind_name=kind, alternate=x) for k, (name, kind, x) in enumerate(rows)]
    last = pdb_atom(4, " CA ", 23, at[4], kind="ATOM", kind_name="GLY")
    for serial in ("ATOM      4", "ATOM  99999", "ATOM 100000"):
        path.write_text("".join([*lines, last.replace("ATOM      4", serial)]))
        found = files.read_molecules(path)
        assert [x.names for x in found] == [("N", "CG"), ("CA",)], serial
        np.testing.assert_array_equal(np.concatenate([x.positions for x in found]), at[::2])


def test_a_straight_molecule_takes_an_axial_moment(tmp_path):
    path = tmp_path / "co2.xyz"
    path.write_text("3\n\nO 0 0 0\nC 0.672 0.672 0.672\nO 1.344 1.344 1.344\n")
    found = files.read_molecule(path)
    shape = found.shape()
    pair = [shape, shape]
    with pytest.raises(ValueError, match=r"positive definite, .*; a straight molecule takes a small axial_moment"):
        li.systems.rigid_bodies(pair, pair, lambda x, R: jnp.sum(x**2))
    given = found.shape(axial_moment=1e-3)
    np.testing.assert_allclose(given.aligned().inertia, [1e-3, *np.linalg.eigvalsh(shape.inertia)[1:]], rtol=1e-10)
    np.testing.assert_allclose(given.inertia @ np.ones(3), 1e-3 * np.ones(3), rtol=1e-10)
    pose = found.superpose(found)
    assert pose.rms < 1e-14
    np.testing.assert_allclose(pose.position, shape.center, rtol=1e-14)
    path.write_text("3\n\nO 0 0 0\nH 0.9 0 0\nH 0 0.9 0\n")
    with pytest.raises(ValueError, match="axial_moment is that of a straight molecule"):
        files.read_molecule(path).shape(axial_moment=1e-3)


WATER_ROWS = [("O", 0.0, 0.0, 0.0), ("H", 0.957, 0.0, 0.0), ("H", -0.24, 0.927, 0.0)]


def test_frames_of_qm9_end_with_their_inchi(tmp_path):
    """Ramakrishnan et al. 2014, Sci. Data 1, table 2: a charge after the position, then frequencies, SMILES, InChI."""
    path = tmp_path / "a.xyz"
    atoms = "O\t0\t0\t0\t-0.589706\nH\t0.957\t0\t0\t0.294853\nH\t-0.24\t0.927\t1.0*^-6\t0.294853\n"
    frame = f"3\ngdb 3\t799.58\t437.90\t282.94\n{atoms}1671.4222\t3803.6305\t3907.698\nO\tO\n"
    frame += "InChI=1S/H2O/h1H2\tInChI=1S/H2O/h1H2\n"
    path.write_text(frame + frame.replace("0.957", "0.9") + "1\nplain\nHe 0 0 0\n")
    first, second, third = files.read_molecules(path)
    np.testing.assert_array_equal(first.positions, [[0, 0, 0], [0.957, 0, 0], [-0.24, 0.927, 1e-6]])
    assert (second.positions[1, 0], third.elements) == (0.9, ("He",))


def test_columns_of_extended_xyz_are_those_of_properties(tmp_path):
    path, lines = tmp_path / "a.xyz", []
    for k, (name, *at) in enumerate(WATER_ROWS):
        lines.append(f"{k} 9 8 7 {2.0 + k} {' '.join(map(str, at))} {name}\n")
    given = 'Lattice="9 0 0 0 9 0 0 0 9" Properties=id:I:1:momenta:R:3:masses:R:1:pos:R:3:species:S:1 pbc="T T T"'
    path.write_text(f"3\n{given}\n{''.join(lines)}")
    found = files.read_molecule(path)
    np.testing.assert_array_equal(found.positions, [row[1:] for row in WATER_ROWS])
    assert (found.elements, found.masses.tolist()) == (("O", "H", "H"), [2.0, 3.0, 4.0])
    assert files.read_molecule(path, masses={"H": 1.5}).masses.tolist() == [2.0, 1.5, 1.5]


def test_deuterium_and_tritium_have_their_masses(tmp_path):
    """Of NIST: 2.014102 and 3.016049 u."""
    path = tmp_path / "a.xyz"
    path.write_text("3\n\nO 0 0 0\nD1 0.957 0 0\nT -0.24 0.927 0\n")
    found = files.read_molecule(path)
    assert found.elements == ("O", "D", "T")
    np.testing.assert_allclose(found.masses, [15.999, 2.014102, 3.016049], rtol=0, atol=1e-4)
    pdb = tmp_path / "a.pdb"
    pdb.write_text(pdb_atom(1, " O  ", 1, [0, 0, 0], "O") + pdb_atom(2, " D1 ", 1, [0.96, 0, 0]))
    assert files.read_molecule(pdb).elements == ("O", "D")


@pytest.mark.parametrize("number", [1, 9999, "****"])
@pytest.mark.parametrize("names", [(" O  ", " H1 ", " H2 "), (" O  ", " H  ", " H  ")])
def test_waters_of_one_residue_number_are_several(number, names, tmp_path):
    """As packmol numbers them; 1.7 Å apart, the length of a hydrogen bond."""
    path, shift = tmp_path / "a.pdb", np.array([0.957 + 1.7, 0.0, 0.0])
    rows = [(k, name, np.array(at)) for k in range(3) for name, (_, *at) in zip(names, WATER_ROWS, strict=True)]
    path.write_text(
        "".join(pdb_atom(i, n, number, at + k * shift, n[1]) for i, (k, n, at) in enumerate(rows)) + "END\n"
    )
    found = files.read_molecules(path)
    assert [x.elements for x in found] == [("O", "H", "H")] * 3
    np.testing.assert_allclose(found[2].positions - found[0].positions, [2 * shift] * 3, rtol=0, atol=2e-3)


def test_molecules_whose_names_repeat_are_one_where_they_are_bonded(tmp_path):
    """Ethylene, nitrogen and hydrogen peroxide with elements as names, as Open Babel writes them; two argon atoms."""
    path = tmp_path / "a.pdb"
    ethylene = [
        ("C", 0, 0, 0),
        ("H", -0.5, 0.9, 0),
        ("H", -0.5, -0.9, 0),
        ("C", 1.34, 0, 0),
        ("H", 1.8, 0.9, 0),
        ("H", 1.8, -0.9, 0),
    ]
    peroxide = [("O", 0, 0, 0), ("H", -0.3, 0.9, 0), ("O", 1.47, 0, 0), ("H", 1.7, 0, 0.9)]
    for atoms, sizes in (
        (ethylene, [6]),
        (peroxide, [4]),
        ([("N", 0, 0, 0), ("N", 1.1, 0, 0)], [2]),
        ([("Ar", 0, 0, 0), ("Ar", 3.8, 0, 0)], [1, 1]),
        ([("I", 0, 0, 0), ("I", 2.67, 0, 0)], [2]),
    ):
        path.write_text("".join(pdb_atom(k, f"{n:>2}  ", 1, at, n) for k, (n, *at) in enumerate(atoms)))
        assert [len(x.names) for x in files.read_molecules(path)] == sizes
