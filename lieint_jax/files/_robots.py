"""Mass, center and inertia of one body of a robot, from URDF and MJCF."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks, shapes
from lieint_jax._text import Text, read_text

__all__ = ["read_mjcf_inertia", "read_urdf_inertia"]

_LINE = ""  # the attribute that holds the line: no attribute of a file has this name
_TENSOR = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # of xx yy zz xy xz yz
_CHANGES = {
    "balanceinertia",
    "boundinertia",
    "boundmass",
    "coordinate",
    "fusestatic",
    "settotalmass",
}  # of MuJoCo's compiler


def read_urdf_inertia(path: str | Path, link: str | None = None) -> shapes.Shape:
    """The mass, center and inertia of one link of a robot's URDF, in the axes of the link, in kg and m.

    Args:
        path: a file of URDF, expanded from xacro.
        link: the name of the link; it may be left out where one link alone has an inertia.

    Raises:
        ValueError: no link of this name, or none has an inertia, or a line that is wrong: numbers that are missing or
            not finite, a mass or an inertia that is not positive, XML that is broken or declares entities.
    """
    text, root = _read_xml(path)
    if root.tag != "robot":
        text.fail(_line(root), f"a URDF begins with <robot>, got <{_checks.printable(root.tag)}>")
    links = [x for x in root.iterfind("link") if x.find("inertial") is not None]
    found = _child(text, links[_choose(text, [x.get("name") for x in links], "link", link)], "inertial")
    tensor, origin = _child(text, found, "inertia"), found.find("origin")
    if origin is not None and (other := set(origin.keys()) - {"xyz", "rpy", _LINE}):
        text.fail(_line(origin), f"<origin> must have xyz and rpy only, got {_checks.printable(min(other))}")
    mass = _numbers(text, _child(text, found, "mass"), "value", 1)
    moments = [_numbers(text, tensor, name, 1)[0] for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
    xyz, rpy = ([0.0] * 3 if origin is None else _numbers(text, origin, x, 3, "0 0 0") for x in ("xyz", "rpy"))
    return _shape(text, _line(found), mass[0], xyz, np.array(moments), _roll_pitch_yaw(*rpy))


def read_mjcf_inertia(path: str | Path, body: str | None = None) -> shapes.Shape:
    """The mass, center and inertia of one body of a MuJoCo model (MJCF), in the axes of the body.

    An `<inertial>` with `pos`, `quat` and `diaginertia` or `fullinertia` is read here. Whatever else decides on the
    inertia (geoms, includes, other angles, `inertiafromgeom="true"`, balancing) the package mujoco computes.

    Args:
        path: a file of MJCF.
        body: the name of the body; it may be left out where the model has one body alone.

    Raises:
        ValueError: no body of this name, or a line that is wrong, as in `read_urdf_inertia`.
        ImportError: mujoco is needed and not installed.
    """
    text, root = _read_xml(path)
    if root.tag != "mujoco":
        text.fail(_line(root), f"an MJCF begins with <mujoco>, got <{_checks.printable(root.tag)}>")
    compiler = [x for tag in ("compiler", "include") for x in root.iter(tag)]
    if any(x.tag == "include" or x.get("inertiafromgeom") == "true" or set(x.keys()) & _CHANGES for x in compiler):
        return _by_mujoco(text, Path(path), body)
    bodies = list(root.iterfind("worldbody//body"))
    names = [x.get("name") for x in bodies]
    k = _choose(text, names, "body", body)
    inertial = bodies[k].find("inertial")
    given = set() if inertial is None else set(inertial.keys())
    if inertial is None or given & {"axisangle", "xyaxes", "zaxis", "euler"}:
        return _by_mujoco(text, Path(path), names[k])
    mass, pos = _numbers(text, inertial, "mass", 1), _numbers(text, inertial, "pos", 3)
    if len(given & {"diaginertia", "fullinertia"}) != 1:
        text.fail(_line(inertial), "an inertial needs one of diaginertia and fullinertia")
    if "fullinertia" in given:
        if "quat" in given:
            text.fail(_line(inertial), "fullinertia is in the axes of the body: it takes no quat")
        moments = np.array(_numbers(text, inertial, "fullinertia", 6))
        return _shape(text, _line(inertial), mass[0], pos, moments, np.eye(3))
    quat = np.array(_numbers(text, inertial, "quat", 4, "1 0 0 0"))
    if not np.linalg.norm(quat) > 0:
        text.fail(_line(inertial), "quat must not be 0")
    moments = np.diag(_numbers(text, inertial, "diaginertia", 3))
    return _shape(text, _line(inertial), mass[0], pos, moments, _matrix(quat))


def _shape(text: Text, line: int, mass: float, center: ArrayLike, J: np.ndarray, R: np.ndarray) -> shapes.Shape:
    """The shape of a tensor J, or moments xx yy zz xy xz yz, in axes that R rotates to those of the body."""
    J = R @ (J if J.ndim == 2 else J[_TENSOR]) @ R.T
    try:
        return shapes.body(mass=mass, center=center, inertia=(J + J.T) / 2)
    except ValueError as error:
        text.fail(line, f"this is not the inertia of a body: {error}")


def _matrix(quat: np.ndarray) -> np.ndarray:
    """The rotation matrix of a quaternion (w, x, y, z) of any length but 0."""
    w, *v = quat / np.linalg.norm(quat)
    K = np.cross(np.eye(3), v)
    return np.eye(3) + 2 * w * K + 2 * K @ K


def _roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """R_z(yaw) R_y(pitch) R_x(roll): rotations about fixed axes, x first."""
    (a, b, c), (s, t, u) = (f(np.array([roll, pitch, yaw])) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, a, -s], [0, s, a]])
    about_y = np.array([[b, 0, t], [0, 1, 0], [-t, 0, b]])
    return np.array([[c, -u, 0], [u, c, 0], [0, 0, 1]]) @ about_y @ about_x


def _by_mujoco(text: Text, path: Path, body: str | None) -> shapes.Shape:
    """What MuJoCo's compiler makes of a body."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            f"{text.name}: the inertia of this body follows from geoms, angles or options of the compiler, which needs "
            "the package mujoco (pip install mujoco); without it an <inertial> with pos, quat and diaginertia is read"
        ) from error
    try:
        model: Any = mujoco.MjModel.from_xml_path(str(path))  # pyright: ignore[reportAttributeAccessIssue]
    except ValueError as error:
        text.fail(0, f"mujoco cannot compile it: {_checks.printable(str(error))}")
    k = 1 + _choose(text, [model.body(k).name or None for k in range(1, model.nbody)], "body", body)
    mass, moments = model.body_mass[k], np.diag(model.body_inertia[k])
    return _shape(text, 0, mass, model.body_ipos[k], moments, _matrix(model.body_iquat[k]))


def _read_xml(path: str | Path) -> tuple[Text, Element]:
    """The root of a file of XML without declarations of entities; elements know their lines."""
    text = read_text(path)
    builder, parser = TreeBuilder(), expat.ParserCreate("utf-8")

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag, attributes | {_LINE: str(parser.CurrentLineNumber)})

    def refuse(*_: object) -> NoReturn:
        text.fail(
            parser.CurrentLineNumber, "a document type is declared (DOCTYPE), which could declare entities: remove it"
        )

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, builder.end, refuse
    try:
        parser.Parse("\n".join(text.lines).encode(), True)
    except expat.ExpatError as error:
        text.fail(error.lineno, f"this is no XML: {expat.errors.messages[error.code]}")
    return text, builder.close()


def _line(element: Element) -> int:
    return int(element.get(_LINE, "0"))


def _choose(text: Text, names: list[str | None], kind: str, name: str | None) -> int:
    """The place of the name that is asked for, or of the only one."""
    if name is None and len(names) == 1:
        return 0
    if name is not None and names.count(name) == 1:
        return names.index(name)
    given = ", ".join(_checks.printable(x) for x in names[:20] if x) + (", …" if len(names) > 20 else "")
    asked = f"two of them are {_checks.printable(name)!r}" if name in names and name else f"got {name!r}"
    raise ValueError(
        f"{text.name}: {kind} must be the name of one with an inertia ({given or 'there is none'}), {asked}"
    )


def _child(text: Text, element: Element, tag: str) -> Element:
    found = element.find(tag)
    if found is None:
        text.fail(_line(element), f"<{element.tag}> needs a <{tag}>")
    return found


def _numbers(text: Text, element: Element, name: str, count: int, default: str | None = None) -> list[float]:
    """The numbers of an attribute."""
    words = (element.get(name, default) or "").split()
    if len(words) != count:
        what = (
            f"<{element.tag}> needs {name} of {count} numbers"
            if count > 1
            else f"<{element.tag}> needs a number {name}"
        )
        text.fail(_line(element), f"{what}, got {_checks.printable(element.get(name))!r}")
    return text.numbers(_line(element), words, name)
