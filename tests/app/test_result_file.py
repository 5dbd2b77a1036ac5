"""What a study leaves on disk: the whole result, from which its report and its picture are made again."""

import errno
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import cli, info, result_file, study
from lieint_jax.app.studies.gyro import GyroTrials
from lieint_jax.app.studies.kappa import KappaErrors

TREE = GyroTrials(
    fit=(1, [2.5, None, "ν"], {0.05: np.arange(3), "x": {"deep": jnp.ones((2, 2))}}),
    estimates=np.array([1.0, np.nan]),
    truth=np.float64(0.1),
    sigmas=True,
    covariance=np.eye(2),
    within_2_sigma=KappaErrors(1.0, np.inf, {0.1: 2.0}, 0.0, 0.0, 3),
    inside_ellipsoid=scenarios.load("toutatis"),
    readings=(),
)


def same(a, b):
    if isinstance(a, np.ndarray | jnp.ndarray):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    elif isinstance(a, dict):
        assert list(a) == list(b)
        assert all(same(a[k], b[k]) for k in a)
    elif isinstance(a, tuple | list):
        assert type(a) is type(b)
        assert len(a) == len(b)
        assert all(map(same, a, b))
    else:
        assert a == b
    return True


def test_a_tree_comes_back_as_it_was(tmp_path):
    path = tmp_path / "tree.npz"
    result_file.save(path, TREE, {"study": "gyro"})
    same(TREE, result_file.load(path))
    assert result_file.metadata(path)["study"] == "gyro"
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["fit.2.x.deep"], 1)  # named by its path, for whoever reads it without us
    with pytest.raises(FileExistsError):
        result_file.save(path, TREE, {})


def test_only_named_tuples_of_this_package_are_made(tmp_path):
    for kind in ("os:system", "lieint_jax.types:Step", "lieint_jax.app.studies.gyro:nothing", "collections:Counter"):
        path = tmp_path / "tree.npz"
        tree = {"type": kind, "fields": {}}
        np.savez(path, metadata=np.array(json.dumps({"study": "gyro", "tree": tree})))
        with pytest.raises(ValueError, match="holds no tree that this version"):
            result_file.load(path)
    with pytest.raises(TypeError, match=r"0.x is of type object"):
        result_file.save(tmp_path / "other.npz", ({"x": object()},), {})


@pytest.mark.parametrize("stopped", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_file_that_cannot_be_written_whole_leaves_nothing(tmp_path, monkeypatch, stopped):
    """On a full disk, or where an interrupt comes: the same command runs again, and the message names the file."""

    def savez(file, **_):
        file.write(b"PK")
        raise stopped

    path = tmp_path / "tree.npz"
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", savez)
        with pytest.raises(type(stopped)) as caught:
            result_file.save(path, TREE, {})
    assert not path.exists()
    if isinstance(stopped, OSError):
        assert cli._sentence(caught.value) == f"{path}: No space left on device"
    result_file.save(path, TREE, {})


def test_two_arrays_of_one_name_and_a_missing_file_are_refused(tmp_path):
    for tree in ({"1": np.ones(2), 1: np.zeros(2)}, {"metadata": np.ones(2)}):
        with pytest.raises(ValueError, match="are called"):
            result_file.save(tmp_path / "tree.npz", tree, {})
    with pytest.raises(ValueError, match="there is no file"):
        result_file.load(tmp_path / "none.npz")


def test_a_study_of_another_version_is_refused_by_name(tmp_path, lieint):
    result_file.save(tmp_path / "tree.npz", (), {"study": "alchemy", "quick": False, "lieint_jax": "9", "jax": "9"})
    for command in ("info", "plot"):
        assert "'alchemy' is not one of" in lieint.refuse(command, str(tmp_path / "tree.npz"))


def test_other_files_are_not_mistaken_for_studies(tmp_path):
    plain, text = tmp_path / "plain.npz", tmp_path / "text.npz"
    np.savez(plain, metadata=np.array('{"scenario": {}}'))
    text.write_text("no archive")
    assert [result_file.metadata(path) for path in (plain, text, tmp_path / "none.npz")] == [None] * 3


@pytest.mark.long
@pytest.mark.parametrize("name", study.studies_by_name())
def test_plot_redoes_a_study_from_its_file(name, tmp_path, monkeypatch, lieint):
    """The report in the same words and the picture pixel by pixel; a second run replaces neither."""
    report = lieint("study", name, "--quick").partition("\nwritten:")[0]
    first = (tmp_path / f"study-{name}.png").read_bytes()
    assert "--force" in lieint.refuse("plot", f"study-{name}.npz")
    assert lieint("plot", f"study-{name}.npz", "--force").partition("\nwritten:")[0] == report
    assert (tmp_path / f"study-{name}.png").read_bytes() == first
    assert f"study {name}, a small one" in lieint("info", f"study-{name}.npz")
    (tmp_path / f"study-{name}.npz").rename("study-before.npz")
    monkeypatch.setattr(
        study.studies_by_name()[name], "run", lambda quick: result_file.load(tmp_path / "study-before.npz")
    )
    assert cli.main(["study", name, "--quick"]) == 0
    assert (tmp_path / f"study-{name}-2.npz").exists()
    assert (tmp_path / f"study-{name}-2.png").read_bytes() == first


def test_the_error_of_an_energy_that_is_zero_is_relative_to_the_kinetic_energy(tmp_path):
    """A top that falls from rest with its axis horizontal: H is 0 and constant to round-off."""
    top = li.systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 1.0])
    fallen = top.state([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], angular_velocity=[0.0, 0.0, 0.0])
    li.run(li.schemes.top_energy_momentum(top), fallen, 0.05, 40).save(tmp_path / "top.zarr")
    relative = re.search(r"\((\S+) of the largest energy\)", info.contents(tmp_path / "top.zarr"))
    assert float(relative[1]) < 3e-15  # observed: 4e-16
