"""Bodies of a SAPIEN scene, built from descriptions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...description import HandDescription, ObjectDescription
from ...description.shape import Shape
from ...typing import Array
from .links import ARMATURE, MovingLink, moving_links, principal
from .sapien_engine import sapien

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

    Raises:
        DescriptionError: as :func:`moving_links`.
    """
    physx, pose = sapien().physx, sapien().Pose
    components: dict[str, Any] = {}
    entities: list[Any] = []
    links = moving_links(hand)
    for link in links:
        entity = sapien().Entity()
        entity.name = link.name
        component = physx.PhysxArticulationLinkComponent(components.get(link.parent or ""))
        component.name = link.name
        entity.add_component(component)
        entities.append(entity)
        components[link.name] = component
        moving = component.joint
        if link.joint is None:
            moving.type = "fixed"
            continue
        turn = x_axis_to(link.joint.axis)
        moving.type, moving.name = "revolute", link.joint.name
        moving.pose_in_parent, moving.pose_in_child = pose(link.placed @ turn), pose(turn)
        limits = np.clip([link.joint.lower, link.joint.upper], -2 * np.pi, 2 * np.pi)
        moving.limits = limits[None].astype(np.float32)
        moving.armature = np.array([ARMATURE], dtype=np.float32)
        moving.set_friction(0.0)  # PhysX would keep 0.05, a fraction of the momentum
    entities[0].pose = pose(links[0].placed)
    link_of: dict[Any, str] = {}
    for link in links:
        link_of |= _fill_link(components[link.name], link, material)
    for entity in entities:
        scene.add_entity(entity)

    articulation = components[links[0].name].articulation
    articulation.sleep_threshold = 0.0
    articulation.solver_position_iterations = 16
    articulation.solver_velocity_iterations = 1
    place = {joint.name: k for k, joint in enumerate(articulation.active_joints)}
    order = np.array([place[name] for name in hand.joint_names])
    joints = [articulation.active_joints[k] for k in order]
    return HandBodies(articulation, joints, order, link_of)


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
    values, axes = principal(inertia)
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


def _fill_link(component: Any, link: MovingLink, material: Any) -> dict[Any, str]:
    built = {_attach(component, shape, at, material, _HAND_GROUP): name for at, shape, name in link.shapes}
    if link.mass > 0:
        set_inertia(component, link.mass, link.com, link.inertia)
    return built


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
