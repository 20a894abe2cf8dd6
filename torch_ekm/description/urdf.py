"""Read a URDF: links with inertia and primitive shapes, joints with axes and limits.

Only what a hand or an object of this package needs: revolute, continuous and fixed joints; boxes,
cylinders, spheres and capsules. Meshes are left out (contacts come from pads, see
:mod:`torch_ekm.description.hand`), and every figure must be finite.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..exceptions import DescriptionError
from .shape import Shape, merge_capsules

Array = NDArray[np.float64]
MOVING = ("revolute", "continuous")


@dataclass(frozen=True)
class UrdfLink:
    """A rigid body. ``inertia`` (3, 3) [kg m^2] is about ``com`` [m], both in the link's axes."""

    name: str
    mass: float
    com: Array
    inertia: Array
    collisions: tuple[Shape, ...]
    has_mesh: bool = False


@dataclass(frozen=True)
class UrdfJoint:
    """``T_parent_child(q) = transform @ rot(axis, q)``; limits [rad], effort [N m], velocity [rad/s]."""

    name: str
    kind: str
    parent: str
    child: str
    transform: Array
    axis: Array
    lower: float
    upper: float
    effort: float
    velocity: float


@dataclass(frozen=True)
class UrdfModel:
    """A tree of links and joints, both in document order."""

    path: Path
    name: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    root: str

    @property
    def moving_joints(self) -> tuple[UrdfJoint, ...]:
        """The joints that have an angle, in document order: the order of ``q``."""
        return tuple(joint for joint in self.joints if joint.kind in MOVING)

    def link(self, name: str) -> UrdfLink:
        return next(link for link in self.links if link.name == name)


def read_urdf(path: str | Path) -> UrdfModel:
    """Parse the URDF at ``path``.

    Raises:
        DescriptionError: no such file, malformed XML, a missing or non-finite figure, an unknown
            joint type, ``<mimic>``, reversed limits, or links that do not form one tree.
    """
    path = Path(path)
    if not path.is_file():
        raise DescriptionError(path, "no such URDF file")
    try:
        robot = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise DescriptionError(path, f"not well-formed XML: {error}") from None
    if robot.tag != "robot":
        raise DescriptionError(path, f"the root element must be <robot>, found <{robot.tag}>")
    reader = _Reader(path)
    links = tuple(reader.link(element) for element in robot.findall("link"))
    joints = tuple(reader.joint(element) for element in robot.findall("joint"))
    root = _root(path, links, joints)
    return UrdfModel(path, robot.get("name", path.stem), links, joints, root)


def pose(xyz: Array, rpy: Array) -> Array:
    """URDF origin: ``R = Rz(yaw) Ry(pitch) Rx(roll)`` and translation ``xyz`` [m], ``(4, 4)``."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    transform = np.eye(4)
    transform[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    transform[:3, 3] = xyz
    return transform


class _Reader:
    """Elements of one file to data; errors name the file, the element and the attribute."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def link(self, element: ET.Element) -> UrdfLink:
        name = self._name(element, "link")
        place = f"link '{name}'"
        mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        inertial = element.find("inertial")
        if inertial is not None:
            frame = self._origin(inertial, f"{place}, inertial")
            mass = self._number(self._child(inertial, "mass", place), "value", f"{place}, mass")
            tensor = self._child(inertial, "inertia", place)
            ixx, iyy, izz = (self._number(tensor, k, f"{place}, inertia") for k in ("ixx", "iyy", "izz"))
            ixy, ixz, iyz = (self._number(tensor, k, f"{place}, inertia", 0.0) for k in ("ixy", "ixz", "iyz"))
            com = frame[:3, 3]
            inertia = frame[:3, :3] @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
            inertia = inertia @ frame[:3, :3].T
            if mass <= 0 or np.linalg.eigvalsh(inertia).min() <= 0:
                raise DescriptionError(self.path, f"{place}: mass and principal inertias must be positive")
        found = [self._shape(c, f"{place}, collision") for c in element.findall("collision")]
        shapes = merge_capsules(tuple(shape for shape in found if shape is not None))
        return UrdfLink(name, mass, com, inertia, shapes, has_mesh=None in found)

    def joint(self, element: ET.Element) -> UrdfJoint:
        name = self._name(element, "joint")
        place = f"joint '{name}'"
        kind = element.get("type", "")
        if kind not in (*MOVING, "fixed"):
            valid = "revolute, continuous and fixed"
            raise DescriptionError(self.path, f"{place}: type '{kind}' is not supported; supported: {valid}")
        if element.find("mimic") is not None:
            hint = "write it as a [[couplings]] entry of the transmission file"
            raise DescriptionError(self.path, f"{place}: <mimic> is not supported; {hint}")
        ends = [self._child(element, tag, place).get("link", "") for tag in ("parent", "child")]
        axis, lower, upper, effort, velocity = np.array([1.0, 0.0, 0.0]), -np.inf, np.inf, np.inf, np.inf
        if kind in MOVING:
            axis_element = element.find("axis")
            if axis_element is not None:
                axis = self._vector(axis_element, "xyz", f"{place}, axis")
            length = float(np.linalg.norm(axis))
            if length < 1e-9:
                raise DescriptionError(self.path, f"{place}: the axis must not be zero")
            axis = axis / length
        if kind == "revolute":
            limit = self._child(element, "limit", place)
            lower, upper, effort, velocity = (
                self._number(limit, key, f"{place}, limit", default)
                for key, default in (("lower", 0.0), ("upper", 0.0), ("effort", np.inf), ("velocity", np.inf))
            )
            if lower > upper:
                raise DescriptionError(self.path, f"{place}: limits reversed, lower {lower} > upper {upper}")
        origin = self._origin(element, place)
        return UrdfJoint(name, kind, ends[0], ends[1], origin, axis, lower, upper, effort, velocity)

    def _shape(self, element: ET.Element, place: str) -> Shape | None:
        geometry = self._child(element, "geometry", place)
        origin = self._origin(element, place)
        for kind in ("box", "cylinder", "sphere", "capsule"):
            found = geometry.find(kind)
            if found is None:
                continue
            if kind == "box":
                size = tuple(self._vector(found, "size", f"{place}, box").tolist())
            else:
                keys = ("radius",) if kind == "sphere" else ("radius", "length")
                size = tuple(self._number(found, key, f"{place}, {kind}") for key in keys)
            if min(size) <= 0:
                raise DescriptionError(
                    self.path, f"{place}: the size of a {kind} must be positive, got {size}"
                )
            return Shape(kind, size, origin)
        return None  # a mesh

    def _name(self, element: ET.Element, tag: str) -> str:
        name = element.get("name")
        if not name:
            raise DescriptionError(self.path, f"a <{tag}> has no name")
        return name

    def _child(self, element: ET.Element, tag: str, place: str) -> ET.Element:
        child = element.find(tag)
        if child is None:
            raise DescriptionError(self.path, f"{place}: <{element.tag}> needs a <{tag}>")
        return child

    def _origin(self, element: ET.Element, place: str) -> Array:
        origin = element.find("origin")
        if origin is None:
            return np.eye(4)
        xyz, rpy = (
            self._vector(origin, key, f"{place}, origin") if key in origin.attrib else np.zeros(3)
            for key in ("xyz", "rpy")
        )
        return pose(xyz, rpy)

    def _vector(self, element: ET.Element, key: str, place: str) -> Array:
        words = element.get(key, "").split()
        if len(words) != 3:
            raise DescriptionError(
                self.path, f"{place}: '{key}' must be three numbers, got '{' '.join(words)}'"
            )
        return np.array([self._parse(word, key, place) for word in words])

    def _number(self, element: ET.Element, key: str, place: str, default: float | None = None) -> float:
        text = element.get(key)
        if text is None:
            if default is None:
                raise DescriptionError(self.path, f"{place}: <{element.tag}> needs the attribute '{key}'")
            return default
        return self._parse(text, key, place)

    def _parse(self, text: str, key: str, place: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise DescriptionError(self.path, f"{place}: '{key}' must be a finite number, got '{text}'")
        return value


def _root(path: Path, links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...]) -> str:
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
                raise DescriptionError(
                    path,
                    f"joint '{joint.name}' names the unknown link '{end}'; links are: {', '.join(names)}",
                )
    children = [joint.child for joint in joints]
    roots = [name for name in names if name not in children]
    if len(roots) != 1 or len(set(children)) != len(children):
        raise DescriptionError(
            path, f"the links must form one tree; links without a parent: {roots or 'none'}"
        )
    reached = {roots[0]}
    for _ in joints:  # as many sweeps as joints reach the deepest link
        reached |= {joint.child for joint in joints if joint.parent in reached}
    if len(reached) != len(names):
        loose = ", ".join(sorted(set(names) - reached))
        raise DescriptionError(path, f"the links must form one tree; not reached from '{roots[0]}': {loose}")
    return roots[0]
