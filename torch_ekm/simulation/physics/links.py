"""The moving links of a hand, for any engine: links on fixed joints are part of what carries them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...description.shape import Shape
from ...description.urdf import UrdfJoint, UrdfLink
from ...exceptions import DescriptionError
from ...typing import Array

ARMATURE = 1e-4  # [kg m^2] motor inertia seen at a joint; lets 1 ms steps carry stiff tendons
JOINT_DAMPING = 5e-3  # [N m s/rad]; the softest freedom (springs alone) settles in 0.1 s


@dataclass
class MovingLink:
    """A link on a joint, or the root (without parent and joint), with all that is fixed to it.

    ``placed`` is the joint's frame in the parent's, or the root's in the hand frame; ``pieces`` are the
    URDF's links, each with its frame in this one's.
    """

    name: str
    parent: str | None
    joint: UrdfJoint | None
    placed: Array
    pieces: list[tuple[Array, UrdfLink]] = field(default_factory=list)

    @property
    def shapes(self) -> Iterator[tuple[Array, Shape, str]]:
        """Frame in this link's, shape, and the name of the URDF's link to which it belongs."""
        for placed, piece in self.pieces:
            yield from ((placed @ one.transform, as_capsule(one), piece.name) for one in piece.collisions)

    def body(self) -> tuple[float, Array, Array]:
        """Mass [kg], centre of mass [m] and inertia about it [kg m^2], in this link's frame."""
        mass, first, about_frame = 0.0, np.zeros(3), np.zeros((3, 3))
        for placed, piece in self.pieces:
            rotation = placed[:3, :3]
            centre = rotation @ piece.com + placed[:3, 3]
            mass += piece.mass
            first += piece.mass * centre
            about_frame += rotation @ piece.inertia @ rotation.T + piece.mass * _steiner(centre)
        com = first / mass if mass > 0 else first
        return mass, com, about_frame - mass * _steiner(com)


def as_capsule(shape: Shape) -> Shape:
    """A cylinder with caps, which stick out by its radius: PhysX has no other whose side is smooth."""
    return replace(shape, kind="capsule") if shape.kind == "cylinder" else shape


def shapes_of(obj: ObjectDescription) -> list[Shape]:
    """Those of an object alone have caps, where nothing grasps; where a broader part begins, fingers come to
    the ends of cylinders."""
    return [as_capsule(shape) if len(obj.shapes) == 1 else shape for shape in obj.shapes]


def moving_links(hand: HandDescription) -> list[MovingLink]:
    """The root and the links on joints, each after the one that carries it.

    Raises:
        DescriptionError: the link of a pad has nothing but meshes to touch with, or the base link moves.
    """
    urdf = hand.urdf
    for pad in hand.pads:
        if urdf.link(pad.link).has_mesh and not urdf.link(pad.link).collisions:
            problem = f"link '{pad.link}' carries the pad '{pad.name}', and its only <collision> is a mesh"
            remedy = "write the pad's capsule there: contacts need box, cylinder, sphere or capsule"
            raise DescriptionError(hand.urdf_path, f"{problem}; {remedy}")
    root = MovingLink(urdf.root, None, None, np.eye(4))
    links, carrier = [root], {urdf.root: (root, np.eye(4))}
    for joint in sorted(urdf.joints, key=lambda joint: len(urdf.joints_to(joint.parent))):
        owner, offset = carrier[joint.parent]
        placed = offset @ joint.transform
        if joint.kind != "fixed":
            owner, placed = MovingLink(joint.child, owner.name, joint, placed), np.eye(4)
            links.append(owner)
        carrier[joint.child] = owner, placed
    for name, (owner, placed) in carrier.items():
        owner.pieces.append((placed, urdf.link(name)))
    owner, base = carrier[hand.base_link]
    if owner is not root:
        raise DescriptionError(hand.urdf_path, f"the base link '{hand.base_link}' must not move with a joint")
    root.placed = np.asarray(np.linalg.inv(base), dtype=np.float64)
    return links


def principal(inertia: Array) -> tuple[Array, Array]:
    """Principal inertias [kg m^2] and their axes, a rotation ``(3, 3)``."""
    values, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return values, axes


def x_axis_to(axis: Array) -> Array:
    """A frame ``(4, 4)`` whose x axis is ``axis``: SAPIEN's joints turn about x."""
    x = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(x))]
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    return frame


def _steiner(point: Array) -> Array:
    return point @ point * np.eye(3) - np.outer(point, point)
