"""Read a URDF through yourdfpy: links with inertia and primitive shapes, joints with axes and limits.

yourdfpy repairs what is malformed, fills in what is missing and takes NaN for a number. So a file is
looked through first, and only what a hand or an object of this package needs is handed over: revolute,
continuous and fixed joints; boxes, cylinders, spheres and capsules. Mesh files are never opened.
"""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import figure
from ..exceptions import DescriptionError
from ..typing import Array
from ._reading import LARGEST_FIGURE, listed, read_xml
from .mimic import Mimic, read_mimics
from .shape import Shape, merge_capsules

# what no hand and no object needs: a file may be a stranger's
_MOST = {"link": 400, "joint": 400, "collision": 2000}

MOVING = ("revolute", "continuous")
_HELD = ("prismatic", "planar", "floating")
_SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
# what is read of an element: its children, those of them that it needs, ...
_CHILDREN = {
    "link": ("inertial", "collision"),
    "inertial": ("origin", "mass", "inertia"),
    "collision": ("origin", "geometry"),
    "geometry": _SHAPES,
    "joint": ("parent", "child", "origin", "axis", "limit", "mimic"),
}
_NEEDED = {"collision": ("geometry",), "joint": ("parent", "child")}
# ... and the attributes that hold figures: those that it needs, and the others
_FIGURES = {
    "origin": ((), ("xyz", "rpy")),
    "mass": (("value",), ()),
    "inertia": (("ixx", "iyy", "izz"), ("ixy", "ixz", "iyz")),
    "axis": (("xyz",), ()),
    "limit": ((), ("lower", "upper", "effort", "velocity")),
    "mimic": ((), ("multiplier", "offset")),
    "box": (("size",), ()),
    "cylinder": (("radius", "length"), ()),
    "sphere": (("radius",), ()),
    "capsule": (("radius", "length"), ()),
}
_TRIPLES = ("xyz", "rpy", "size")

_NOTHING = 1e-9  # of the largest principal inertia: zero, rounded
_ROD = 1e-3  # least principal inertia of the largest
_BALL = 0.005  # [m] radius


@dataclass(frozen=True)
class UrdfLink:
    """A rigid body. ``inertia`` (3, 3) [kg m^2] is about ``com`` [m], both in the link's axes."""

    name: str
    mass: float
    com: Array
    inertia: Array
    collisions: tuple[Shape, ...]
    has_mesh: bool = False
    """Whether there are meshes, which ``collisions`` leaves out."""
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Where the frame of the MJCF's body begins, whose axes are the link's [m]."""


@dataclass(frozen=True)
class UrdfJoint:
    """``T_parent_child(q) = transform @ rot(axis, q)``; limits [rad]."""

    name: str
    kind: str
    parent: str
    child: str
    transform: Array
    axis: Array
    lower: float
    upper: float


@dataclass(frozen=True)
class UrdfModel:
    """A tree of links and joints, both in document order."""

    path: Path
    name: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    root: str
    mimics: tuple[Mimic, ...] = ()
    """Joints that are tied to others; a transmission file has the last word."""
    notes: tuple[str, ...] = ()
    """What was assumed of the file, each in a sentence."""

    @property
    def moving_joints(self) -> tuple[UrdfJoint, ...]:
        """The joints that have an angle, in document order: the order of ``q``."""
        return tuple(joint for joint in self.joints if joint.kind in MOVING)

    def link(self, name: str) -> UrdfLink:
        return next(link for link in self.links if link.name == name)

    def joints_to(self, link: str) -> list[UrdfJoint]:
        """The joints between the root and a link, that of the root first."""
        carried_by, joints = {joint.child: joint for joint in self.joints}, []
        while link in carried_by:
            joints.append(carried_by[link])
            link = carried_by[link].parent
        return joints[::-1]

    def pose(self, link: str) -> Array:
        """``T_root_link`` at zero angles, ``(4, 4)`` [m]."""
        T = np.eye(4)
        for joint in self.joints_to(link):
            T = T @ joint.transform
        return T

    def below(self, base: str, named: Iterable[str] = (), path: Path | None = None) -> UrdfModel:
        """The part that ``base`` carries, as a tree of its own, with a note on what is left out.

        A base that carries no joint is a frame: of all that is carried by what it is fixed to. One that is
        fixed to the root keeps the whole tree if a joint ``named`` is elsewhere. A joint that is a
        ``<mimic>`` of one that is left out is locked.

        Raises:
            DescriptionError: there is no link of that name; it names ``path``, or the URDF.
        """
        names = [link.name for link in self.links]
        if base not in names:
            problem = f"unknown base_link '{base}'; links are: {', '.join(names)}"
            raise DescriptionError(path or self.path, problem)
        top, joints, to_base = base, self._beyond(base), self.joints_to(base)
        while to_base and to_base[-1].kind == "fixed" and not any(joint.kind in MOVING for joint in joints):
            top = to_base.pop().parent
            joints = self._beyond(top)
        kept = {joint.name for joint in joints}
        left_out = {joint.name for joint in self.moving_joints} - kept
        fixed = all(joint.kind == "fixed" for joint in to_base)
        if not left_out or (fixed and left_out & set(named)):
            return self
        notes = [f"the hand is what '{top}' carries; {len(left_out)} joints elsewhere are left out"]
        mimics = []
        for mimic in self.mimics:
            if mimic.joint in kept and mimic.other in left_out:
                notes.append(
                    f"'{mimic.joint}' is a <mimic> of '{mimic.other}', which is left out: it is locked"
                )
                mimic = replace(mimic, multiplier=0.0)
            mimics += [mimic] if mimic.joint in kept else []
        below = {top, *(joint.child for joint in joints)}
        links = tuple(link for link in self.links if link.name in below)
        notes = (*notes, *self.notes)
        return replace(self, links=links, joints=joints, root=top, mimics=tuple(mimics), notes=notes)

    def _beyond(self, link: str) -> tuple[UrdfJoint, ...]:
        """The joints that a link carries, in document order."""
        below = [link]
        for one in below:
            below += [joint.child for joint in self.joints if joint.parent == one]
        return tuple(joint for joint in self.joints if joint.parent in below)


def read_urdf(path: str | Path) -> UrdfModel:
    """Parse the URDF at ``path``; joints that slide or float are held, with a note.

    Inertias that no solid body has are mended for the simulator, with a note: exporters round them.

    Raises:
        DescriptionError: no such file, malformed XML, a missing or non-finite figure or one above 1e9, an
            unknown joint type, reversed limits, links that do not form one tree, or more than 4 MiB, 400
            links, 400 joints or 2000 collision shapes.
        MissingExtraError: yourdfpy is not installed.
    """
    path = Path(path)
    root = read_xml(path, "URDF file", "robot")
    for tag, most in _MOST.items():
        there = sum(1 for _ in root.iter(tag))
        if there > most:
            raise DescriptionError(path, f"at most {most} elements <{tag}> are read, this file has {there}")
    strict = ET.Element("robot", name=root.get("name", path.stem))
    held = []
    for element in root:
        if element.tag == "link":
            strict.append(_strict(path, element, _place(path, element)))
        elif element.tag == "joint":
            strict.append(_strict_joint(path, element))
            held += [element.get("name", "")] if element.get("type") in _HELD else []
    document = io.BytesIO(ET.tostring(strict))
    robot = require("yourdfpy").URDF.load(document, build_scene_graph=False, load_meshes=False).robot
    mended: list[str] = []
    links = tuple(_link(path, link, mended) for link in robot.links)
    joints = tuple(_joint(path, joint) for joint in robot.joints)
    base = root_of(path, links, joints)
    mimics, notes = read_mimics(robot.joints)
    if held:
        notes.append(listed("joints that slide or float are held at 0", held))
    if mended:
        notes.append(listed("inertias of no solid body (zero, rounded) are mended for the simulator", mended))
    return UrdfModel(path, robot.name, links, joints, base, mimics, tuple(notes))


def _place(path: Path, element: ET.Element) -> str:
    name = element.get("name")
    if not name:
        raise DescriptionError(path, f"a <{element.tag}> has no name")
    return f"{element.tag} '{name}'"


def _strict_joint(path: Path, element: ET.Element) -> ET.Element:
    place, kind = _place(path, element), element.get("type", "")
    if kind in _HELD:
        kind = "fixed"
    if kind not in (*MOVING, "fixed"):
        valid = "revolute, continuous and fixed"
        raise DescriptionError(path, f"{place}: type '{kind}' is not supported; supported: {valid}")
    if kind == "revolute" and element.find("limit") is None:
        raise DescriptionError(path, f"{place}: <joint> needs a <limit> [rad], or type 'continuous'")
    unread = {"revolute": (), "continuous": ("limit",), "fixed": ("axis", "limit", "mimic")}
    strict = _strict(path, element, place, unread[kind])
    strict.set("type", kind)
    return strict


def _strict(path: Path, element: ET.Element, place: str, unread: tuple[str, ...] = ()) -> ET.Element:
    """What is read of ``element``: nothing missing, every figure a finite number."""
    tag = element.tag
    strict = ET.Element(tag, {} if tag == "mesh" else element.attrib)
    needed, optional = _FIGURES.get(tag, ((), ()))
    for key in (*needed, *optional):
        text = element.get(key)
        if text is not None:
            strict.set(key, _figures(path, f"{place}: '{key}'", text, key in _TRIPLES))
        elif key in needed:
            raise DescriptionError(path, f"{place}: <{tag}> needs the attribute '{key}'")
    for key in _NEEDED.get(tag, ()):
        if element.find(key) is None:
            raise DescriptionError(path, f"{place}: <{tag}> needs a <{key}>")
    for child in element:
        if child.tag in _CHILDREN.get(tag, ()) and child.tag not in unread:
            strict.append(_strict(path, child, f"{place}, {child.tag}"))
    if tag == "geometry" and len(strict) != 1:
        raise DescriptionError(path, f"{place}: <geometry> needs one of {', '.join(_SHAPES)}")
    if tag == "collision":  # yourdfpy knows no capsule: it is passed as a cylinder whose name states the kind
        shape = next(strict.iter("geometry"))[0]
        strict.set("name", shape.tag)
        shape.tag = "cylinder" if shape.tag == "capsule" else shape.tag
    return strict


def _figures(path: Path, what: str, text: str, triple: bool) -> str:
    words = text.split() if triple else [text.strip()]
    if triple and len(words) != 3:
        raise DescriptionError(path, f"{what} must be three numbers, got '{text}'")
    values = [figure(word) for word in words]
    for word, value in zip(words, values, strict=True):
        if value is None or not math.isfinite(value):
            raise DescriptionError(path, f"{what} must be a finite number, got '{word}'")
        if abs(value) > LARGEST_FIGURE:
            raise DescriptionError(path, f"{what} must be at most {LARGEST_FIGURE:g} in size, got '{word}'")
    return " ".join(map(repr, values))


def _link(path: Path, link: Any, mended: list[str]) -> UrdfLink:
    """From a ``yourdfpy.Link``."""
    mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if link.inertial is not None:
        frame = _pose(link.inertial.origin)
        mass, com = link.inertial.mass or 0.0, frame[:3, 3]
        inertia = np.zeros((3, 3)) if link.inertial.inertia is None else link.inertial.inertia
        inertia = frame[:3, :3] @ inertia @ frame[:3, :3].T
        if mass < 0:
            raise DescriptionError(path, f"link '{link.name}': the mass must not be negative, got {mass} kg")
        if inertia_problem(mass, inertia):
            mended.append(link.name)
            inertia = mended_inertia(mass, inertia)
    shapes = [_shape(path, link.name, found) for found in link.collisions if found.name != "mesh"]
    has_mesh = len(shapes) < len(link.collisions)
    return UrdfLink(link.name, mass, com, inertia, merge_capsules(tuple(shapes)), has_mesh)


def inertia_problem(mass: float, inertia: Array) -> str:
    """What no solid body can have; empty: nothing. No principal inertia exceeds the sum of the others."""
    if not 0 < mass < math.inf or not np.isfinite(inertia).all():
        return f"mass and principal inertias must be positive and finite, got a mass of {mass} kg"
    small, middle, large = np.linalg.eigvalsh(inertia)
    if small <= _NOTHING * large or large <= 0:
        return "mass and principal inertias must be positive"
    if large > (1 + 1e-3) * (small + middle):  # a thin plate has equality, written with few digits
        figures = f"{small:.3g}, {middle:.3g}, {large:.3g} kg m^2"
        return f"the largest principal inertia must not exceed the sum of the others, got {figures}"
    return ""


def mended_inertia(mass: float, inertia: Array) -> Array:
    """The nearest inertia of a solid body, in the same axes; without mass: none.

    The largest principal inertia stays. One that is less than 1/1000 of it is raised to that (a thin rod has
    as little), and the two smaller ones to where their sum is the largest. Without any: a ball of 5 mm.
    """
    values, axes = np.linalg.eigh(inertia)
    if mass == 0 or values[2] <= 0:
        return 0.4 * mass * _BALL**2 * np.eye(3)
    values = values.clip(_ROD * values[2])
    values[:2] += max(0.0, values[2] - values[0] - values[1]) / 2
    return axes @ np.diag(values) @ axes.T


def _shape(path: Path, link: str, collision: Any) -> Shape:
    kind, geometry = collision.name, collision.geometry
    if geometry.box is not None:
        size = tuple(geometry.box.size.tolist())
    elif geometry.sphere is not None:
        size = (geometry.sphere.radius,)
    else:
        size = (geometry.cylinder.radius, geometry.cylinder.length)
    if min(size) <= 0:
        problem = f"the size of a {kind} must be positive, got {size}"
        raise DescriptionError(path, f"link '{link}', collision: {problem}")
    return Shape(kind, size, _pose(collision.origin))


def _joint(path: Path, joint: Any) -> UrdfJoint:
    """From a ``yourdfpy.Joint``."""
    place, length = f"joint '{joint.name}'", float(np.linalg.norm(joint.axis))
    if length < 1e-9:
        raise DescriptionError(path, f"{place}: the axis must not be zero")
    lower, upper = -np.inf, np.inf
    if joint.limit is not None:
        limit = joint.limit
        lower, upper = limit.lower or 0.0, limit.upper or 0.0
        if lower > upper:
            raise DescriptionError(path, f"{place}: limits reversed, lower {lower} > upper {upper}")
    ends = joint.parent or "", joint.child or ""
    frame, axis = _pose(joint.origin), joint.axis / length
    return UrdfJoint(joint.name, joint.type, *ends, frame, axis, lower, upper)


def _pose(origin: Array | None) -> Array:
    return np.eye(4) if origin is None else origin


def root_of(path: Path, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint]) -> str:
    """The one link without a parent; every other link must be reached from it."""
    names = [link.name for link in links]
    if not names:
        raise DescriptionError(path, "there is no <link>")
    for kind, seen in (("link", names), ("joint", [joint.name for joint in joints])):
        twice = sorted({name for name in seen if seen.count(name) > 1})
        if twice:
            raise DescriptionError(path, f"{kind} names must be unique, repeated: {', '.join(twice)}")
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in names:
                problem = f"names the unknown link '{end}'; links are: {', '.join(names)}"
                raise DescriptionError(path, f"joint '{joint.name}' {problem}")
    children = [joint.child for joint in joints]
    roots = [name for name in names if name not in children]
    if len(roots) != 1 or len(set(children)) != len(children):
        problem = f"the links must form one tree; links without a parent: {roots or 'none'}"
        raise DescriptionError(path, problem)
    reached = {roots[0]}
    for _ in joints:  # as many sweeps as joints reach the deepest link
        reached |= {joint.child for joint in joints if joint.parent in reached}
    if len(reached) != len(names):
        loose = ", ".join(sorted(set(names) - reached))
        raise DescriptionError(path, f"the links must form one tree; not reached from '{roots[0]}': {loose}")
    return roots[0]
