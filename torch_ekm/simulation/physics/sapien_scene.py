"""A fixed hand and one free object in SAPIEN."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np

from ..._extras import require
from ...description import HandDescription, ObjectDescription
from ...description.shape import Shape
from ...exceptions import ParameterError
from ...typing import Array
from .links import ARMATURE, JOINT_DAMPING, moving_links, principal, shapes_of, x_axis_to

_TOLERANCE_LENGTH = 0.02  # [m] size of the things simulated; PhysX's defaults are for furniture
_TOLERANCE_SPEED = 0.1  # [m/s]
_CONTACT_OFFSET = 0.0005  # [m]; at the default 10 mm friction acts on points that do not touch
_HAND_GROUP = 1  # bodies that share a bit of the third collision word ignore each other
_TORQUE_LIMIT = 100.0  # [N m]; a limit that never acts
_SIDES = 64  # of a cylinder with flat ends: 0.06 % of the radius; of more PhysX drops some
_FINE = 1e3  # sizes are given in mm: PhysX merges corners that are less than some mm apart


@cache
def _sapien() -> tuple[Any, Any]:
    """The module ``sapien``, and its engine, made for small things: PhysX allows one in a process, and drops
    it with its last reference."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*[Vv]ulkan.*")  # which only a renderer needs
        module = require("sapien")
    return module, module.physx.PhysxEngine(_TOLERANCE_LENGTH, _TOLERANCE_SPEED)


class SapienScene:
    """A :class:`Scene` in SAPIEN's PhysX, without a renderer.

    The solver is PGS: TGS applies gravity once per step but drives once per sub-iteration, which shifts
    equilibria by about ``dt^2 k / I``. PhysX takes a negative restitution for the stiffness of a contact.
    """

    def __init__(
        self, hand: HandDescription, obj: ObjectDescription, time_step: float, contact_stiffness: float
    ) -> None:
        self._sapien, _ = _sapien()
        self._physx = self._sapien.physx
        self.time_step = time_step
        self._configure(hand)
        self._system: Any = self._physx.PhysxCpuSystem()
        self._system.timestep = time_step
        self._scene: Any = self._sapien.Scene([self._system])
        mu, restitution = obj.friction, -contact_stiffness
        self._material, self._opposed = (self._physx.PhysxMaterial(mu, mu, restitution) for _ in range(2))
        """Of the object and all links but those of the finger that opposes the others, and of these."""
        self._link_of: dict[Any, str] = {}
        """Name of the URDF's link to which each collision shape belongs, of links on fixed joints too."""
        self._add_hand(hand)
        self._add_object(hand, obj)

    # -- building -----------------------------------------------------------------------------------

    def _configure(self, hand: HandDescription) -> None:
        physx = self._physx
        config = physx.get_scene_config()
        config.gravity = hand.gravity
        config.enable_tgs = False
        config.enable_pcm = True
        config.enable_enhanced_determinism = True
        config.bounce_threshold = 0.05
        physx.set_scene_config(config)
        shape = physx.get_shape_config()
        shape.contact_offset, shape.rest_offset = _CONTACT_OFFSET, 0.0
        physx.set_shape_config(shape)
        body = physx.get_body_config()
        body.sleep_threshold = 0.0
        body.solver_position_iterations, body.solver_velocity_iterations = 16, 1
        physx.set_body_config(body)

    def _add_hand(self, hand: HandDescription) -> None:
        """The articulation, its base fixed at the origin."""
        pose = self._sapien.Pose
        components: dict[str, Any] = {}
        entities: list[Any] = []
        links = moving_links(hand)
        for link in links:
            entity = self._sapien.Entity()
            component = self._physx.PhysxArticulationLinkComponent(components.get(link.parent or ""))
            entity.name = component.name = link.name
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
        for link in links:
            for at, shape, name in link.shapes:
                self._link_of[self._attach(components[link.name], at, shape, _HAND_GROUP)] = name
            mass, com, inertia = link.body()
            if mass > 0:
                self._set_mass(components[link.name], mass, com, inertia)
        for entity in entities:
            self._scene.add_entity(entity)
        self._hand: Any = components[links[0].name].articulation
        self._hand.sleep_threshold = 0.0
        self._hand.solver_position_iterations = 16
        self._hand.solver_velocity_iterations = 1
        place = {joint.name: k for k, joint in enumerate(self._hand.active_joints)}
        self._order = np.array([place[name] for name in hand.joint_names])
        """Place of each joint in SAPIEN's (breadth-first) order."""
        self._joints = [self._hand.active_joints[k] for k in self._order]

    def _add_object(self, hand: HandDescription, obj: ObjectDescription) -> None:
        """One free rigid body; that of a planar hand neither leaves the plane nor tilts out of it.

        Raises:
            ParameterError: the normal is not an axis of the hand frame, as PhysX's locks need.
        """
        entity = self._sapien.Entity()
        entity.name = obj.name
        self._object: Any = self._physx.PhysxRigidDynamicComponent()
        for shape in shapes_of(obj):
            self._attach(self._object, shape.transform, shape, group=0)
        self._object.linear_damping = self._object.angular_damping = 0.0
        entity.add_component(self._object)
        self._scene.add_entity(entity)
        self.set_object(obj)
        if hand.planar_normal is not None:
            across = np.abs(hand.planar_normal) / np.linalg.norm(hand.planar_normal) > 1 - 1e-9
            if not across.any():
                valid = "x, y or z of the hand frame, to be simulated"
                raise ParameterError("planar_normal", tuple(hand.planar_normal), valid)
            self._object.set_locked_motion_axes([*across.tolist(), *(~across).tolist()])

    def _attach(self, body: Any, placed: Array, shape: Shape, group: int) -> Any:
        if shape.kind == "box":
            built = self._physx.PhysxCollisionShapeBox(np.array(shape.size) / 2, self._material)
        elif shape.kind == "sphere":
            built = self._physx.PhysxCollisionShapeSphere(shape.size[0], self._material)
        elif shape.kind == "cylinder":
            # PhysX has no smooth cylinder: its own has 32 flat sides, this one as many as it takes
            turns, (radius, length) = 2 * np.pi * np.arange(_SIDES) / _SIDES, shape.size
            radius /= np.sqrt(np.cos(np.pi / _SIDES))  # sides are as much inside as edges are outside
            rim = np.stack([radius * np.cos(turns), radius * np.sin(turns), np.full(_SIDES, length / 2)], 1)
            corners, scale = _FINE * np.concatenate([rim, rim * (1, 1, -1)]), np.full(3, 1 / _FINE)
            built = self._physx.PhysxCollisionShapeConvexMesh(corners, scale, self._material)
        else:
            radius, length = shape.size
            built = self._physx.PhysxCollisionShapeCapsule(radius, length / 2, self._material)
            placed = placed @ x_axis_to(np.array([0.0, 0.0, 1.0]))
        built.local_pose = self._sapien.Pose(placed)
        built.set_collision_groups([1, 1, group, 0])
        body.attach(built)
        return built

    def _set_mass(self, body: Any, mass: float, com: Array, inertia: Array) -> None:
        values, axes = principal(inertia)
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = axes, com
        body.mass, body.cmass_local_pose, body.inertia = mass, self._sapien.Pose(frame), values

    # -- properties that may change in mid-run ----------------------------------------------------

    def set_object(self, obj: ObjectDescription) -> None:
        self._set_mass(self._object, obj.mass, obj.com, obj.inertia)

    def set_friction(self, friction: float, opposed: float, links: set[str]) -> None:
        """PhysX takes the mean of the two bodies' coefficients."""
        for shape, link in self._link_of.items():
            if link in links:
                shape.set_physical_material(self._opposed)
        for material, value in ((self._material, friction), (self._opposed, 2 * opposed - friction)):
            material.static_friction = material.dynamic_friction = value

    def set_link_weight(self, pulls: bool) -> None:
        for link in self._hand.links:
            link.disable_gravity = not pulls

    def set_drive_stiffness(self, stiffness: Array) -> None:
        for joint, value in zip(self._joints, stiffness, strict=True):
            joint.set_drive_properties(float(value), JOINT_DAMPING, _TORQUE_LIMIT, "force")

    # -- state --------------------------------------------------------------------------------------

    @property
    def q(self) -> Array:
        return self._hand.qpos.astype(np.float64)[self._order]

    @property
    def next_q(self) -> Array:
        return self.q + self.time_step * self._hand.qvel.astype(np.float64)[self._order]

    @property
    def object_pose(self) -> tuple[Array, Array]:
        matrix = self._object.entity_pose.to_transformation_matrix().astype(np.float64)
        u, _, vt = np.linalg.svd(matrix[:3, :3])  # it came in float32
        return matrix[:3, 3], u @ vt

    @property
    def object_speed(self) -> tuple[float, float]:
        linear, angular = self._object.linear_velocity, self._object.angular_velocity
        return float(np.linalg.norm(linear)), float(np.linalg.norm(angular))

    def place(self, q: Array, position: Array, rotation: Array) -> None:
        self._hand.qpos = q[np.argsort(self._order)].astype(np.float32)
        self._hand.qvel = np.zeros(len(q), dtype=np.float32)
        matrix = np.eye(4)
        matrix[:3, 3], matrix[:3, :3] = position, rotation
        self._object.entity_pose = self._sapien.Pose(matrix)

    def hold_object(self, held: bool) -> None:
        if self._object.kinematic and not held:
            self._object.kinematic = False
            self._object.linear_velocity = self._object.angular_velocity = np.zeros(3, np.float32)
        elif held:
            self._object.kinematic = True

    # -- time ---------------------------------------------------------------------------------------

    def step(self, drive_targets: Array) -> None:
        for joint, target in zip(self._joints, drive_targets.tolist(), strict=True):
            joint.set_drive_target(target)
        self._system.step()

    def push(self, force: Array, torque: Array) -> None:
        self._object.add_force_torque(force.astype(np.float32), torque.astype(np.float32))

    def touches(self) -> dict[str, float]:
        """PhysX gives the normal part of each impulse; pairs within the contact offset that carry nothing are
        listed too and left out here."""
        found: dict[str, list[tuple[list[float], float]]] = {}
        for contact in self._system.get_contacts():
            first, second = contact.bodies
            if self._object not in (first, second):
                continue
            link = self._link_of[contact.shapes[1 if first == self._object else 0]]
            for point in contact.points:
                impulse = np.asarray(point.impulse, dtype=np.float64)
                if impulse @ impulse > 0:
                    size = float(np.linalg.norm(impulse / self.time_step))
                    found.setdefault(link, []).append((point.position.tolist(), size))
        # in the order of the points: that of PhysX is not defined
        return {link: float(np.sum([size for _, size in sorted(points)])) for link, points in found.items()}

    def snapshot(self) -> bytes:
        """Positions and velocities. Contact caches are not in it: a run that goes on from here and
        one that is restored to here differ by some micrometres; restored runs are all alike."""
        return self._system.pack()

    def restore(self, state: bytes) -> None:
        self._system.unpack(state)
