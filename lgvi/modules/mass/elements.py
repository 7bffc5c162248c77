"""The element `inertial` of URDF and MJCF: mass, centre and inertia as text, and back."""

import reprlib
from collections.abc import Iterable, Iterator
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from ...core import so3

# Of roots that are something else.
FORMATS = {"robot": "URDF: use `from_urdf`", "mujoco": "MJCF: use `from_mjcf`", "sdf": "SDF"}
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
    root = _parse(text)
    element, _ = _find(root, "link", link)
    _require_known(element, "origin", "mass", "inertia")
    origin, mass, inertia = (element.find(name) for name in ("origin", "mass", "inertia"))
    if mass is None or inertia is None:
        raise ValueError(
            "Argument `text` must have `mass` and `inertia` in its element `inertial`, but has "
            f"{_quoted(child.tag for child in element)}."
        )
    centre, axes = np.zeros(3), np.eye(3)
    if origin is not None:
        centre = _numbers(origin, "xyz", 3, "0 0 0")
        axes = _of_angles(_numbers(origin, "rpy", 3, "0 0 0"))
    xx, xy, xz, yy, yz, zz = (
        _numbers(inertia, name, 1)[0] for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    inertial = Inertial(_numbers(mass, "value", 1)[0], centre, axes @ J @ axes.T)
    _refuse_changes(root, inertial)  # of an element `mujoco` in the robot
    return inertial


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
    root = _parse(text)
    place = _find(root, "body", body)
    _require_not_aligned(root, place.element)
    inertial = _in_holder(_read_mjcf_element(place.element), place.frames)
    _refuse_changes(root, inertial)
    return inertial


def _read_mjcf_element(element: ElementTree.Element) -> Inertial:
    mass, centre = _numbers(element, "mass", 1)[0], _numbers(element, "pos", 3)
    axes = _axes(element)
    present = [name for name in ("fullinertia", "diaginertia") if name in element.attrib]
    if len(present) != 1 or (present == ["fullinertia"] and "quat" in element.attrib):
        raise ValueError(
            "Argument `text` must give the inertia by `fullinertia`, or by `diaginertia` and "
            f"perhaps `quat`, but has {_quoted(element.attrib)}."
        )
    if present == ["fullinertia"]:
        xx, yy, zz, xy, xz, yz = _numbers(element, "fullinertia", 6)
        return Inertial(mass, centre, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    moments = _numbers(element, "diaginertia", 3)
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


class _Place(NamedTuple):
    """An element `inertial`, and the elements `frame` of MJCF between it and its holder."""

    element: ElementTree.Element
    frames: tuple[ElementTree.Element, ...] = ()


def _parse(text: str) -> ElementTree.Element:
    """The root of a text, with names without the default namespace, as other readers see them."""
    if not isinstance(text, str):
        raise TypeError(f"Argument `text` must be XML in a string, but is {_shortened(text)}.")
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(
            "Argument `text` must be XML, the text of a file and not its path, but is not: "
            f"{error}."
        ) from None
    if any("xacro}" in element.tag for element in root.iter()):
        raise ValueError(f"Argument `text` must be a model, but is xacro: {_EXPAND}.")
    for element in root.iter():
        element.tag = element.tag.split("}")[-1]
    return root


def _within(
    holder: ElementTree.Element, tag: str, frames: tuple[ElementTree.Element, ...] = ()
) -> Iterator[_Place]:
    """The elements of a tag that belong to a holder, some of them in frames."""
    for child in holder:
        if child.tag == tag:
            yield _Place(child, frames)
        elif child.tag == "frame":
            yield from _within(child, tag, (*frames, child))


def _find(root: ElementTree.Element, holder: str, name: str | None) -> _Place:
    """The element `inertial`, of the holder of a name where several holders have a mass."""
    own = "robot" if holder == "link" else "mujoco"
    if root.tag in FORMATS and root.tag != own:
        raise ValueError(f"Argument `text` must be of another format, but is {FORMATS[root.tag]}.")
    if root.tag == "inertial":
        if name is not None:
            raise ValueError(
                f"Argument `{holder}` must be None for an `inertial` alone, but is {name!r}."
            )
        return _Place(root)
    holders = list(root.iter(holder))
    with_inertial = [each for each in holders if any(_within(each, "inertial"))]
    with_geoms = [
        each for each in holders if each not in with_inertial and any(_within(each, "geom"))
    ]
    if name is None:
        matching = with_inertial + with_geoms
    else:
        matching = [each for each in holders if each.get("name") == name]
    if len(matching) == 1 and matching[0] in with_inertial:
        place, *others = _within(matching[0], "inertial")
        if others:
            raise ValueError(
                f"Argument `text` must have one `inertial` in a {holder}, but has "
                f"{len(others) + 1}."
            )
        return place
    wanted = "one element" if name is None else f"one {holder} named {_shortened(name)}"
    message = (
        f"Argument `text` must have {wanted} with `inertial`; "
        f"with it are {_listed(holders, with_inertial)}"
    )
    if with_geoms:
        message += f", and without it, but with geoms, {_listed(holders, with_geoms)}"
    if name is None and with_inertial:
        named = any(each.get("name") for each in matching)
        choose = f"choose one by `{holder}`, or " if named else ""
        message += f": {choose}give its `inertial` alone"
    elif hint := _why_none(root, holder, holders if name is None else matching):
        message += f". {hint}"
    raise ValueError(f"{message}.")


def _listed(holders: list[ElementTree.Element], some: list[ElementTree.Element]) -> str:
    """Names of holders; where a name does not tell them apart, their places among all."""
    names = [each.get("name") for each in holders]

    def word(place: int) -> str:
        name = names[place]
        if name is None:
            return f"number {place + 1}, without a name"
        return _shortened(name) + (f" (number {place + 1})" if names.count(name) > 1 else "")

    return _first_of([word(holders.index(each)) for each in some])


def _why_none(
    root: ElementTree.Element, holder: str, looked_at: list[ElementTree.Element]
) -> str | None:
    """Why a text may have no element `inertial` in the holders that were looked at."""
    elements = list(root.iter())
    if any("${" in value for element in elements for value in element.attrib.values()):
        return f"The text is xacro: {_EXPAND}"
    if any(element.tag == "include" for element in elements):
        return "An `include` is not followed: give the text of the file that has the body"
    if holder == "body" and any(any(_within(each, "geom")) for each in looked_at):
        return (
            "The mass of a body without `inertial` is in its geoms: compile the model with MuJoCo, "
            f"and take {_COMPILED}"
        )
    if len(looked_at) > 1 and any(any(_within(each, "inertial")) for each in looked_at):
        return f"Several {holder}s have that name"
    if holder == "link" and looked_at:
        return (
            "In URDF a link without `inertial` has no mass: its `visual` and `collision` give none"
        )
    if root.tag in ("mass", "inertia", "origin", "geom"):
        return f"The text is an element `{root.tag}` alone"
    if not any(element.tag == "inertial" for element in elements):
        return "The text has no element `inertial` at all"
    return None


_EXPAND = "expand it by the program `xacro` first"
_COMPILED = "`body_mass`, `body_ipos`, `body_iquat` and `body_inertia`"


def _require_known(element: ElementTree.Element, *names: str) -> None:
    """Check that an element has each of some elements at most once, and no others."""
    tags = [child.tag for child in element]
    if wrong := [tag for tag in tags if tag not in names or tags.count(tag) > 1]:
        listed = ", ".join(f"`{name}`" for name in names)
        raise ValueError(
            f"Argument `text` must have {listed} in its element `{element.tag}`, each once, but "
            f"has {_quoted(wrong)}."
        )


def _require_not_aligned(root: ElementTree.Element, inertial: ElementTree.Element) -> None:
    """Refuse a body whose frame MuJoCo moves to its centre of mass."""
    for body in root.iter("body"):
        if any(place.element is inertial for place in _within(body, "inertial")):
            joints = (place.element for place in _within(body, "freejoint"))
            if any(joint.get("align") == "true" for joint in joints):
                raise ValueError(
                    'Argument `text` must have no `freejoint` with `align="true"`, by which the '
                    f"frame of the body is another: compile the model with MuJoCo, and take "
                    f"{_COMPILED}."
                )


def _refuse_changes(root: ElementTree.Element, body: Inertial) -> None:
    """Refuse a model in which settings of the compiler of MuJoCo change the body."""
    for compiler in root.iter("compiler"):
        moments = np.linalg.eigvalsh(body.inertia)
        bounds = {
            name: _numbers(compiler, name, 1, "-1")[0]
            for name in ("boundmass", "boundinertia", "settotalmass")
        }
        changes = {
            "balanceinertia": compiler.get("balanceinertia") == "true"
            and moments[0] + moments[1] < moments[2],
            "boundmass": bounds["boundmass"] > body.mass,
            "boundinertia": bounds["boundinertia"] > moments[0],
            "settotalmass": bounds["settotalmass"] > 0,
            "fusestatic": compiler.get("fusestatic") == "true",
            "alignfree": compiler.get("alignfree") == "true",
            "inertiafromgeom": compiler.get("inertiafromgeom") == "true",
        }
        for name, does_change in changes.items():
            if does_change:
                value = compiler.get(name)
                raise ValueError(
                    "Argument `text` must have no setting of the compiler that changes bodies, but "
                    f'has `{name}="{value}"`: compile the model with MuJoCo, and take {_COMPILED}.'
                )


def _in_holder(body: Inertial, frames: tuple[ElementTree.Element, ...]) -> Inertial:
    """A body of the innermost of some frames, in the holder of the outermost."""
    for frame in reversed(frames):
        axes = _axes(frame)
        centre = _numbers(frame, "pos", 3, "0 0 0") + axes @ body.centre
        body = Inertial(body.mass, centre, axes @ body.inertia @ axes.T)
    return body


def _axes(element: ElementTree.Element) -> np.ndarray:
    """The rotation by the quaternion of an element of MJCF."""
    if present := [name for name in ORIENTATIONS if name in element.attrib]:
        raise ValueError(
            "Argument `text` must give the axes of the inertia by `quat` or `fullinertia`, but has "
            f"`{present[0]}` in its element `{element.tag}`: compile the model with MuJoCo, and "
            f"take {_COMPILED}."
        )
    quaternion = _numbers(element, "quat", 4, "1 0 0 0")
    if not np.any(quaternion):
        raise ValueError("Argument `text` must have a `quat` that is not zero, but has 0 0 0 0.")
    return np.asarray(so3.wxyz_to_matrix(quaternion))


def _shortened(value: object) -> str:
    return _SHORT.repr(value)


def _quoted(names: Iterable[str]) -> str:
    return _first_of([_shortened(name) for name in names])


def _first_of(words: list[str]) -> str:
    if len(words) > 5:
        words = [*words[:5], f"and {len(words) - 5} more"]
    return ", ".join(words) or "none"


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 40


def _numbers(
    element: ElementTree.Element, name: str, count: int, default: str | None = None
) -> np.ndarray:
    text = element.get(name, default)
    if text is None:
        raise ValueError(
            f"Argument `text` must have the attribute `{name}` in its element `{element.tag}`, "
            f"but has {_quoted(element.attrib)}."
        )
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Argument `text` must have {count} finite number{'s' * (count > 1)} in the attribute "
            f"`{name}` of its element `{element.tag}`, but has {_shortened(text)}"
            f"{f': {_EXPAND}' if '${' in text else ''}."
        )
    return values
