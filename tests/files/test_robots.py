"""Inertias of URDF and MJCF: closed forms, and what MuJoCo's own compiler makes of the same numbers."""

import data_files
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lieint_jax import files, shapes

URDF, MJCF = data_files.text("samples/arm.urdf"), data_files.text("samples/arm.mjcf")
J = np.array([[1.1, 0.1, -0.05], [0.1, 1.3, 0.02], [-0.05, 0.02, 0.9]])
angles = st.lists(st.floats(-7, 7), min_size=3, max_size=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("robots")


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@settings(max_examples=20, deadline=None)
@given(angles)
def test_roll_pitch_and_yaw_are_rotations_about_fixed_axes(folder, rpy):
    """scipy's "xyz" in lower case: about fixed axes, x first."""
    path = write(folder / "a.urdf", URDF.format(rpy=" ".join(map(str, rpy))))
    found = files.read_urdf_inertia(path, "upper")
    R = Rotation.from_euler("xyz", rpy).as_matrix()
    np.testing.assert_allclose(found.inertia, R @ J @ R.T, rtol=0, atol=3e-15)
    np.testing.assert_array_equal(found.center, [0.1, -0.2, 0.3])
    assert float(found.mass) == 2.5


def test_the_only_link_with_an_inertia_needs_no_name(folder):
    path = write(folder / "b.urdf", URDF.format(rpy="0 0 0"))
    assert float(files.read_urdf_inertia(path).mass) == 2.5
    for name in ("base", "elbow"):
        with pytest.raises(ValueError, match=rf"link must be the name of one with an inertia \(upper\), got '{name}'"):
            files.read_urdf_inertia(path, name)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1), st.booleans())
def test_mjcf_is_what_mujoco_compiles(folder, q, full):
    mujoco = pytest.importorskip("mujoco")
    inertia = f'quat="{" ".join(map(str, q))}" diaginertia="1.1 1.3 0.9"'
    if full:
        inertia = 'fullinertia="1.1 1.3 0.9 0.1 -0.05 0.02"'
    path = write(folder / "a.xml", MJCF.format(inertia=inertia))
    found = files.read_mjcf_inertia(path, "arm")
    model = mujoco.MjModel.from_xml_path(str(path))
    w, *v = model.body("arm").iquat
    R = Rotation.from_quat([*v, w]).as_matrix()
    np.testing.assert_allclose(found.inertia, R @ np.diag(model.body("arm").inertia) @ R.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.center, model.body("arm").ipos, rtol=0, atol=1e-15)


def test_what_geoms_and_angles_say_is_compiled_by_mujoco(folder, monkeypatch):
    pytest.importorskip("mujoco")
    path = write(folder / "c.xml", MJCF.format(inertia='euler="90 0 0" diaginertia="1.1 1.3 0.9"'))
    hand, box = files.read_mjcf_inertia(path, "hand"), shapes.box([0.2, 0.4, 0.6], density=100.0)
    assert float(hand.mass) == pytest.approx(float(box.mass), rel=1e-12, abs=0)
    np.testing.assert_allclose(hand.inertia, np.diag(box.inertia), rtol=0, atol=1e-12)
    np.testing.assert_allclose(hand.center, [0, 0.1, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        files.read_mjcf_inertia(path, "arm").inertia, np.diag([1.1, 0.9, 1.3]), rtol=0, atol=1e-12
    )
    other = path.read_text().replace("<worldbody>", '<compiler inertiafromgeom="true"/><worldbody>')
    without = write(folder / "d.xml", other.replace("geom type", "site type").replace('density="100"', ""))
    with pytest.raises(ValueError, match=r"d\.xml: this is not the inertia of a body: mass must be positive, got 0"):
        files.read_mjcf_inertia(without, "hand")
    with pytest.raises(ValueError, match=r"d\.xml: mujoco cannot compile it: .*sphyr"):
        files.read_mjcf_inertia(write(without, other.replace("box", "sphyr")), "hand")
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"c\.xml: the inertia of this body follows from geoms, .*pip install mujoco"):
        files.read_mjcf_inertia(path, "hand")


def test_a_moment_that_no_body_has_is_read_with_a_warning(folder):
    path = write(folder / "e.urdf", URDF.format(rpy="0 0 0").replace('izz="0.9"', 'izz="9"'))
    with pytest.warns(UserWarning, match="break the triangle inequality"):
        files.read_urdf_inertia(path)


def test_deep_and_hostile_documents_end_in_a_sentence(folder):
    deep = write(folder / "f.urdf", "<robot>" + "<link>" * 300_000)
    with pytest.raises(ValueError, match=r"f\.urdf, line 1: this is no XML: no element found"):
        files.read_urdf_inertia(deep)
    names = "".join(f'<link name="\x1f{k}"><inertial/></link>' for k in range(50)).replace("\x1f", "\u202e")
    with pytest.raises(ValueError, match=r"\\u202e0, .*, …\), got None"):
        files.read_urdf_inertia(write(folder / "g.urdf", f"<robot>{names}</robot>"))
