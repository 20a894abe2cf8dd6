"""Bodies of a SAPIEN scene, built from descriptions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...description import HandDescription, ObjectDescription
from ...description.shape import Shape
from ...description.urdf import UrdfJoint, UrdfLink, UrdfModel
from ...exceptions import DescriptionError
from ...typing import Array
from .engine import sapien

_ARMATURE = 1e-4  # [kg m^2] motor inertia seen at a joint; lets 1 ms steps carry stiff tendons
_HAND_GROUP = 1  # bodies that share a bit of the third collision word ignore each other


class HandBodies(NamedTuple):
    """The hand in the scene. Joints are in the order of ``HandDescription.joint_names``."""

    articulation: Any
    joints: list[Any]
    order: NDArray[np.int64]
    """Place of each joint in SAPIEN's (breadth-first) order."""
    link_of: dict[Any, str]
    """Name of the URDF's link to which each collision shape belongs, of links on fixed joints too."""


def build_hand(scene: Any, hand: HandDescription, material: Any) -> HandBodies:
    """The articulation of ``hand``, its base fixed at the origin: hand frame = world frame.

    Links on fixed joints become part of the link that carries them.

    Raises:
        DescriptionError: the link of a pad has nothing but meshes to touch with, or the base link moves.
    """
    physx, pose = sapien().physx, sapien().Pose
    urdf = hand.urdf
    for pad in hand.pads:
        if urdf.link(pad.link).has_mesh and not urdf.link(pad.link).collisions:
            problem = f"link '{pad.link}' carries the pad '{pad.name}', and its only <collision> is a mesh"
            remedy = "write the pad's capsule there: contacts need box, cylinder, sphere or capsule"
            raise DescriptionError(hand.urdf_path, f"{problem}; {remedy}")
    components: dict[str, Any] = {}
    entities: list[Any] = []

    def add_link(name: str, parent: Any) -> Any:
        entity = sapien().Entity()
        entity.name = name
        link = physx.PhysxArticulationLinkComponent(parent)
        link.name = name
        entity.add_component(link)
        entities.append(entity)
        components[name] = link
        return link.joint

    root = urdf.root
    add_link(root, None).type = "fixed"
    carrier: dict[str, tuple[str, Array]] = {root: (root, np.eye(4))}
    parts: dict[str, list[tuple[Array, UrdfLink]]] = {root: [(np.eye(4), urdf.link(root))]}
    for joint in _parents_first(urdf):
        owner, offset = carrier[joint.parent]
        placed = offset @ joint.transform
        child = urdf.link(joint.child)
        if joint.kind == "fixed":
            carrier[joint.child] = (owner, placed)
            parts[owner].append((placed, child))
            continue
        carrier[joint.child] = (joint.child, np.eye(4))
        parts[joint.child] = [(np.eye(4), child)]
        moving = add_link(joint.child, components[owner])
        turn = x_axis_to(joint.axis)
        moving.type, moving.name = "revolute", joint.name
        moving.pose_in_parent, moving.pose_in_child = pose(placed @ turn), pose(turn)
        limits = np.clip([joint.lower, joint.upper], -2 * np.pi, 2 * np.pi)
        moving.limits = limits[None].astype(np.float32)
        moving.armature = np.array([_ARMATURE], dtype=np.float32)
        moving.set_friction(0.0)  # PhysX would keep 0.05, a fraction of the momentum
    owner, base = carrier[hand.base_link]
    if owner != root:
        raise DescriptionError(hand.urdf_path, f"the base link '{hand.base_link}' must not move with a joint")
    entities[0].pose = pose(np.linalg.inv(base))
    link_of: dict[Any, str] = {}
    for name, pieces in parts.items():
        link_of |= _fill_link(components[name], pieces, material)
    for entity in entities:
        scene.add_entity(entity)

    articulation = components[root].articulation
    articulation.sleep_threshold = 0.0
    articulation.solver_position_iterations = 16
    articulation.solver_velocity_iterations = 1
    place = {joint.name: k for k, joint in enumerate(articulation.active_joints)}
    order = np.array([place[name] for name in hand.joint_names])
    joints = [articulation.active_joints[k] for k in order]
    return HandBodies(articulation, joints, order, link_of)


def _parents_first(urdf: UrdfModel) -> list[UrdfJoint]:
    """The joints, each after the one that carries its parent link."""
    placed, waiting, order = {urdf.root}, list(urdf.joints), []
    while waiting:
        ready = [joint for joint in waiting if joint.parent in placed]
        order += ready
        placed |= {joint.child for joint in ready}
        waiting = [joint for joint in waiting if joint.child not in placed]
    return order


def build_object(scene: Any, obj: ObjectDescription, material: Any) -> Any:
    """The object as one free rigid body; its entity frame is the object frame."""
    entity = sapien().Entity()
    entity.name = obj.name
    body = sapien().physx.PhysxRigidDynamicComponent()
    for shape in obj.shapes:
        _attach(body, shape, shape.transform, material, group=0)
    body.linear_damping = body.angular_damping = 0.0
    entity.add_component(body)
    scene.add_entity(entity)
    return body


def set_inertia(body: Any, mass: float, com: Array, inertia: Array) -> None:
    """Mass [kg], centre [m] and inertia about it [kg m^2], in the body's frame."""
    values, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, com
    body.mass, body.cmass_local_pose, body.inertia = mass, sapien().Pose(frame), values


def x_axis_to(axis: Array) -> Array:
    """A frame ``(4, 4)`` whose x axis is ``axis``: SAPIEN's joints turn about x."""
    x = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(x))]
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    return frame


def _fill_link(link: Any, pieces: list[tuple[Array, UrdfLink]], material: Any) -> dict[Any, str]:
    mass, first, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    link_of = {}
    for placed, piece in pieces:
        for shape in piece.collisions:
            built = _attach(link, shape, placed @ shape.transform, material, _HAND_GROUP)
            link_of[built] = piece.name
        if piece.mass > 0:
            rotation = placed[:3, :3]
            centre = rotation @ piece.com + placed[:3, 3]
            mass += piece.mass
            first += piece.mass * centre
            inertia += rotation @ piece.inertia @ rotation.T + piece.mass * _steiner(centre)
    if mass > 0:
        set_inertia(link, mass, first / mass, inertia - mass * _steiner(first / mass))
    return link_of


def _attach(body: Any, shape: Shape, placed: Array, material: Any, group: int) -> Any:
    physx = sapien().physx
    if shape.kind == "box":
        built = physx.PhysxCollisionShapeBox(np.array(shape.size) / 2, material)
    elif shape.kind == "sphere":
        built = physx.PhysxCollisionShapeSphere(shape.size[0], material)
    else:
        # PhysX has no smooth cylinder (32 flat sides). A capsule has the same side; its caps stick
        # out by a radius at either end, where nothing grasps.
        radius, length = shape.size
        built = physx.PhysxCollisionShapeCapsule(radius, length / 2, material)
        placed = placed @ x_axis_to(np.array([0.0, 0.0, 1.0]))
    built.local_pose = sapien().Pose(placed)
    built.set_collision_groups([1, 1, group, 0])
    body.attach(built)
    return built


def _steiner(point: Array) -> Array:
    return point @ point * np.eye(3) - np.outer(point, point)
