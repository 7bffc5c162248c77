"""The element `inertial` of URDF and MJCF: mass, centre and inertia as text, and back."""

from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from ...core import so3

ORIENTATIONS = ("axisangle", "xyaxes", "zaxis", "euler")  # of MJCF, which are not read


class Inertial(NamedTuple):
    """Mass, kg, centre of mass (3,), m, and inertia (3, 3) about it, kg m², in one frame."""

    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


def write_urdf(body: Inertial) -> str:
    """The element in URDF, with axes of the link frame."""
    J = body.inertia
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    entries = (J[0, 0], J[0, 1], J[0, 2], J[1, 1], J[1, 2], J[2, 2])
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", xyz=_text(body.centre), rpy="0 0 0")
    ElementTree.SubElement(element, "mass", value=_text([body.mass]))
    attributes = {name: _text([each]) for name, each in zip(names, entries, strict=True)}
    ElementTree.SubElement(element, "inertia", attributes)
    return _written(element)


def read_urdf(text: str, link: str | None) -> Inertial:
    """The element in URDF: alone, of the only link, or of a named link.

    Raises
    ------
    ValueError
        If there is no such element, or it is malformed.
    """
    element = _find(text, "link", link)
    origin, mass, inertia = (element.find(name) for name in ("origin", "mass", "inertia"))
    if mass is None or inertia is None:
        raise ValueError(
            "Argument `text` must have `mass` and `inertia` in its element `inertial`, but has "
            f"{[child.tag for child in element]}."
        )
    centre, axes = np.zeros(3), np.eye(3)
    if origin is not None:
        centre = _numbers(origin, "xyz", 3, "0 0 0")
        axes = _of_angles(_numbers(origin, "rpy", 3, "0 0 0"))
    xx, xy, xz, yy, yz, zz = (
        _numbers(inertia, name, 1)[0] for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertial(_numbers(mass, "value", 1)[0], centre, axes @ J @ axes.T)


def write_mjcf(body: Inertial) -> str:
    """The element in MJCF, with axes of the frame of the body."""
    J = body.inertia
    entries = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
    attributes = {"pos": _text(body.centre), "mass": _text([body.mass])}
    return _written(ElementTree.Element("inertial", attributes, fullinertia=_text(entries)))


def read_mjcf(text: str, body: str | None) -> Inertial:
    """The element in MJCF: alone, of the only body that has one, or of a named body.

    Raises
    ------
    ValueError
        If there is no such element, or it is malformed.
    """
    element = _find(text, "body", body)
    if present := [name for name in ORIENTATIONS if name in element.attrib]:
        raise ValueError(
            "Argument `text` must give the axes of the inertia by `quat` or `fullinertia`, but has "
            f"`{present[0]}`."
        )
    mass, centre = _numbers(element, "mass", 1)[0], _numbers(element, "pos", 3)
    present = [name for name in ("fullinertia", "diaginertia") if name in element.attrib]
    if len(present) != 1 or (present == ["fullinertia"] and "quat" in element.attrib):
        raise ValueError(
            "Argument `text` must give the inertia by `fullinertia`, or by `diaginertia` and "
            f"perhaps `quat`, but has {list(element.attrib)}."
        )
    if present == ["fullinertia"]:
        xx, yy, zz, xy, xz, yz = _numbers(element, "fullinertia", 6)
        return Inertial(mass, centre, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    moments = _numbers(element, "diaginertia", 3)
    quaternion = _numbers(element, "quat", 4, "1 0 0 0")
    if not np.any(quaternion):
        raise ValueError("Argument `text` must have a `quat` that is not zero, but has 0 0 0 0.")
    axes = np.asarray(so3.wxyz_to_matrix(quaternion))
    return Inertial(mass, centre, axes * moments @ axes.T)


def _text(numbers) -> str:
    """Numbers with all their digits."""
    return " ".join(repr(float(each)) for each in numbers)


def _written(element: ElementTree.Element) -> str:
    ElementTree.indent(element)
    return ElementTree.tostring(element, encoding="unicode")


def _of_angles(rpy: np.ndarray) -> np.ndarray:
    """The rotation of roll, pitch and yaw, one after the other about the fixed axes x, y and z."""
    roll, pitch, yaw = (np.asarray(so3.exp(turn)) for turn in np.diag(rpy))
    return yaw @ pitch @ roll


def _find(text: str, holder: str, name: str | None) -> ElementTree.Element:
    """The element `inertial`, of the holder of a name where there are several."""
    if not isinstance(text, str):
        raise TypeError(f"Argument `text` must be XML in a string, but is {text!r}.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(
            "Argument `text` must be XML, the text of a file and not its path, but is not: "
            f"{error}."
        ) from None
    if root.tag == "inertial" and name is None:
        return root
    holders = [each for each in root.iter(holder) if each.find("inertial") is not None]
    matching = [holder for holder in holders if name in (None, holder.get("name"))]
    if len(matching) != 1:
        names = ", ".join(repr(each.get("name")) for each in holders) or "none"
        wanted = "one element" if name is None else f"one {holder} named {name!r}"
        ending = f": choose one by `{holder}`" if name is None and holders else ""
        raise ValueError(
            f"Argument `text` must have {wanted} with `inertial`; with it are {names}{ending}."
        )
    element = matching[0].find("inertial")
    assert element is not None
    return element


def _numbers(
    element: ElementTree.Element, name: str, count: int, default: str | None = None
) -> np.ndarray:
    text = element.get(name, default)
    if text is None:
        raise ValueError(
            f"Argument `text` must have the attribute `{name}` in its element `{element.tag}`, "
            f"but has {list(element.attrib)}."
        )
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Argument `text` must have {count} finite number{'s' * (count > 1)} in the attribute "
            f"`{name}` of its element `{element.tag}`, but has {text!r}."
        )
    return values
