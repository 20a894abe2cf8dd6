"""A fixed hand and one free object in a SAPIEN scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...exceptions import ParameterError
from ...typing import Array
from .links import JOINT_DAMPING
from .sapien_bodies import build_hand, build_object, set_inertia
from .sapien_engine import new_scene, sapien

_TORQUE_LIMIT = 100.0  # [N m]; a limit that never acts


class SapienScene:
    """Bodies, time and contacts: physics only, nothing of transmissions, servos or sensors.

    Args:
        hand: the hand; its URDF gives links, inertias and shapes. Hand frame = world frame.
        obj: the object, as it really is.
        time_step: [s].
        contact_stiffness: of each contact [N/m]; 0: rigid. PhysX takes a negative restitution for it.
    """

    def __init__(
        self, hand: HandDescription, obj: ObjectDescription, time_step: float, contact_stiffness: float
    ) -> None:
        self.time_step = time_step
        self._scene: Any = new_scene(hand.gravity, time_step)
        self._system: Any = self._scene.physx_system
        material = sapien().physx.PhysxMaterial
        mu, restitution = obj.friction, -contact_stiffness
        self._material, self._opposed = (material(mu, mu, restitution) for _ in range(2))
        """Of the object and all links but those of the finger that opposes the others, and of these."""
        self._hand = build_hand(self._scene, hand, self._material)
        self._object = build_object(self._scene, obj, self._material)
        self.set_object(obj)
        if hand.planar_normal is not None:
            self._keep_in_plane(np.array(hand.planar_normal))
        self._back = np.argsort(self._hand.order)

    def _keep_in_plane(self, normal: Array) -> None:
        """A planar hand's object neither leaves the plane nor tilts out of it.

        Raises:
            ParameterError: the normal is not an axis of the hand frame, as PhysX's locks need.
        """
        across = np.abs(normal) / np.linalg.norm(normal) > 1 - 1e-9
        if not across.any():
            raise ParameterError(
                "planar_normal", tuple(normal), "x, y or z of the hand frame, to be simulated"
            )
        self._object.set_locked_motion_axes([*across.tolist(), *(~across).tolist()])

    # -- properties that may change in mid-run ----------------------------------------------------

    def set_object(self, obj: ObjectDescription) -> None:
        set_inertia(self._object, obj.mass, obj.com, obj.inertia)

    def oppose(self, links: set[str]) -> None:
        for shape, link in self._hand.link_of.items():
            if link in links:
                shape.set_physical_material(self._opposed)

    def set_friction(self, friction: float, opposed: float) -> None:
        """Coefficients of the object's two sides, the second at the finger that opposes the others.

        PhysX takes the mean of the two bodies' coefficients."""
        for material, value in ((self._material, friction), (self._opposed, 2 * opposed - friction)):
            material.static_friction = material.dynamic_friction = value

    def set_link_weight(self, pulls: bool) -> None:
        for link in self._hand.articulation.links:
            link.disable_gravity = not pulls

    def set_drive_stiffness(self, stiffness: Array) -> None:
        for joint, value in zip(self._hand.joints, stiffness, strict=True):
            joint.set_drive_properties(float(value), JOINT_DAMPING, _TORQUE_LIMIT, "force")

    # -- state --------------------------------------------------------------------------------------

    @property
    def q(self) -> Array:
        return self._hand.articulation.qpos.astype(np.float64)[self._hand.order]

    @q.setter
    def q(self, value: Array) -> None:
        self._hand.articulation.qpos = value[self._back].astype(np.float32)
        self._hand.articulation.qvel = np.zeros(len(value), dtype=np.float32)

    @property
    def next_q(self) -> Array:
        return self.q + self.time_step * self._hand.articulation.qvel.astype(np.float64)[self._hand.order]

    @property
    def object_pose(self) -> tuple[Array, Array]:
        """The object frame in the hand frame: ``(3,)`` [m] and ``(3, 3)``, orthogonal to float64."""
        matrix = self._object.entity_pose.to_transformation_matrix().astype(np.float64)
        u, _, vt = np.linalg.svd(matrix[:3, :3])  # it came in float32
        return matrix[:3, 3], u @ vt

    @object_pose.setter
    def object_pose(self, pose: tuple[Array, Array]) -> None:
        matrix = np.eye(4)
        matrix[:3, 3], matrix[:3, :3] = pose
        self._object.entity_pose = sapien().Pose(matrix)

    @property
    def object_speed(self) -> tuple[float, float]:
        linear, angular = self._object.linear_velocity, self._object.angular_velocity
        return float(np.linalg.norm(linear)), float(np.linalg.norm(angular))

    def hold_object(self, held: bool) -> None:
        if self._object.kinematic and not held:
            self._object.kinematic = False
            self._object.linear_velocity = self._object.angular_velocity = np.zeros(3, np.float32)
        elif held:
            self._object.kinematic = True

    # -- time ---------------------------------------------------------------------------------------

    def step(self, drive_targets: Array) -> None:
        for joint, target in zip(self._hand.joints, drive_targets.tolist(), strict=True):
            joint.set_drive_target(target)
        self._system.step()

    def push(self, force: Array, torque: Array) -> None:
        self._object.add_force_torque(force.astype(np.float32), torque.astype(np.float32))

    def touches(self) -> dict[str, float]:
        """Links that touch the object now, each with the sum of the sizes of its normal forces [N].

        PhysX gives the normal part of each impulse; pairs within the contact offset that carry
        nothing are listed too and left out here.
        """
        found: dict[str, list[tuple[list[float], float]]] = {}
        for contact in self._system.get_contacts():
            first, second = contact.bodies
            if self._object not in (first, second):
                continue
            link = self._hand.link_of[contact.shapes[1 if first == self._object else 0]]
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
