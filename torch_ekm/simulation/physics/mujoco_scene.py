"""A fixed hand and one free object in MuJoCo."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from ..._extras import require
from ...description import HandDescription, ObjectDescription
from ...description.shape import Shape
from ...typing import Array
from .links import ARMATURE, JOINT_DAMPING, moving_links, principal, shapes_of

_FIXED = 1e6  # [kg] and [kg m^2] added to an object that is held
_LEAST_MASS, _LEAST_INERTIA = 1e-6, 1e-10  # of links without mass: MuJoCo takes no zeros
_NARROW = 1e-6  # [rad] between the limits of a joint that cannot move
_IMPEDANCE = 0.95  # of contacts: the share of a contact's motion that its force takes away
_STIFF_TIME = 2.0  # time steps in which a rigid contact closes


class MujocoScene:
    """A :class:`Scene` in MuJoCo: elliptic friction cones, Newton's solver, the same bodies as in SAPIEN.

    Only the object and links collide. A drive ``k (target - q - dt v)`` is the force ``k (target - q)`` with
    the damping ``dt k``, which MuJoCo integrates implicitly. A rigid contact is as stiff as the time step
    allows.
    """

    def __init__(
        self, hand: HandDescription, obj: ObjectDescription, time_step: float, contact_stiffness: float
    ) -> None:
        self._mj: Any = require("mujoco")
        self.time_step = time_step
        spec = self._mj.MjSpec()
        spec.compiler.degree = False
        spec.compiler.balanceinertia = True
        option = spec.option
        option.timestep, option.gravity = time_step, hand.gravity
        option.cone = self._mj.mjtCone.mjCONE_ELLIPTIC
        option.integrator = self._mj.mjtIntegrator.mjINT_IMPLICITFAST
        option.impratio, option.noslip_iterations, option.tolerance = 1000.0, 20, 1e-10  # else contacts creep
        link_of = self._add_hand(spec, hand)
        shapes = self._add_object(spec, hand, obj)
        solref, solimp = [_STIFF_TIME * time_step, 1.0], [_IMPEDANCE, _IMPEDANCE, 0.001, 0.5, 2.0]
        for one, other in itertools.product(link_of, shapes):
            spec.add_pair(geomname1=one, geomname2=other, condim=3, solref=solref, solimp=solimp)
        self._model: Any = spec.compile()
        self._data: Any = self._mj.MjData(self._model)
        self._arrange(hand, link_of, shapes)
        self._soften(contact_stiffness)
        self.set_drive_stiffness(np.zeros(hand.n_q))

    # -- building -----------------------------------------------------------------------------------

    def _add_hand(self, spec: Any, hand: HandDescription) -> dict[str, str]:
        """The name of the URDF's link of each geom."""
        bodies: dict[str, Any] = {}
        link_of: dict[str, str] = {}
        for link in moving_links(hand):
            parent = bodies[link.parent] if link.parent is not None else spec.worldbody
            # of a name of its own: that of an MJCF is MuJoCo's own "world"
            bodies[link.name] = body = parent.add_body(name=f"link/{link.name}", gravcomp=1.0)
            body.pos, body.quat = link.placed[:3, 3], self._quaternion(link.placed[:3, :3])
            mass, com, inertia = link.body()
            self._set_mass(body, max(mass, _LEAST_MASS), com, inertia)
            if link.joint is not None:
                low, high = np.clip([link.joint.lower, link.joint.upper], -2 * np.pi, 2 * np.pi)
                body.add_joint(
                    name=link.joint.name,
                    axis=link.joint.axis,
                    range=[low, max(high, low + _NARROW)],
                    limited=True,
                    armature=ARMATURE,
                    solref_limit=[_STIFF_TIME * self.time_step, 1.0],
                )
            for at, shape, name in link.shapes:
                geom = f"{name}/{len(link_of)}"
                link_of[geom] = name
                self._add_shape(body, geom, at, shape)
        return link_of

    def _add_object(self, spec: Any, hand: HandDescription, obj: ObjectDescription) -> list[str]:
        """Names of its geoms. A planar hand's object neither leaves the plane nor tilts out of it."""
        kinds = self._mj.mjtJoint
        body = spec.worldbody.add_body(name="object")
        self._set_mass(body, obj.mass, obj.com, obj.inertia)
        self._normal = None if hand.planar_normal is None else np.array(hand.planar_normal)
        if self._normal is None:
            body.add_freejoint()
        else:
            self._normal = self._normal / np.linalg.norm(self._normal)
            for axis in np.linalg.svd(self._normal[None])[2][1:]:
                body.add_joint(type=kinds.mjJNT_SLIDE, axis=axis)
            body.add_joint(type=kinds.mjJNT_HINGE, axis=self._normal)
        names = [f"object/{k}" for k in range(len(obj.shapes))]
        for name, shape in zip(names, shapes_of(obj), strict=True):
            self._add_shape(body, name, shape.transform, shape)
        return names

    def _add_shape(self, body: Any, name: str, at: Array, shape: Shape) -> None:
        kind, size = getattr(self._mj.mjtGeom, f"mjGEOM_{shape.kind.upper()}"), np.zeros(3)
        size[: len(shape.size)] = np.array(shape.size) / 2
        if shape.kind != "box":
            size[0] = shape.size[0]  # the radius
        quaternion = self._quaternion(at[:3, :3])
        body.add_geom(
            name=name, type=kind, size=size, pos=at[:3, 3], quat=quaternion, contype=0, conaffinity=0
        )

    def _set_mass(self, body: Any, mass: float, com: Array, inertia: Array) -> None:
        values, axes = principal(inertia)
        body.explicitinertial, body.mass, body.ipos = True, mass, com
        body.iquat, body.inertia = self._quaternion(axes), np.maximum(values, _LEAST_INERTIA)

    def _arrange(self, hand: HandDescription, link_of: dict[str, str], shapes: list[str]) -> None:
        """Where things are in MuJoCo's arrays."""
        model = self._model
        joints = [model.joint(name) for name in hand.joint_names]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._body = model.body("object").id
        first = int(model.body_jntadr[self._body])
        self._at, self._dofs = int(model.jnt_qposadr[first]), slice(int(model.jnt_dofadr[first]), None)
        self._links = {model.geom(geom).id: name for geom, name in link_of.items()}
        self._object_geoms = {model.geom(name).id for name in shapes}
        self._held: Array | None = None

    def _soften(self, stiffness: float) -> None:
        """A contact at rest carries ``f = k_ref r / (d (1 - d) A)``, A its inverse mass as MuJoCo has it."""
        if stiffness <= 0:
            return
        model = self._model
        weights = model.body_invweight0[:, 0]
        for k in range(model.npair):
            bodies = model.geom_bodyid[[model.pair_geom1[k], model.pair_geom2[k]]]
            reference = stiffness * _IMPEDANCE * (1 - _IMPEDANCE) * weights[bodies].sum()
            model.pair_solref[k] = -reference, -2 * np.sqrt(reference)

    # -- properties that may change in mid-run ----------------------------------------------------

    def set_object(self, obj: ObjectDescription) -> None:
        values, axes = principal(obj.inertia)
        model, before = self._model, self.snapshot()
        model.body_mass[self._body], model.body_ipos[self._body] = obj.mass, obj.com
        model.body_inertia[self._body] = values
        model.body_iquat[self._body] = self._quaternion(axes)
        self._mj.mj_setConst(model, self._data)
        self.restore(before)

    def set_friction(self, friction: float, opposed: float, links: set[str]) -> None:
        pairs = zip(self._model.pair_geom1, self._model.pair_geom2, strict=True)
        at_them = [any(self._links.get(geom) in links for geom in pair) for pair in pairs]
        self._model.pair_friction[:, :2] = np.where(at_them, opposed, friction)[:, None]

    def set_link_weight(self, pulls: bool) -> None:
        self._model.body_gravcomp[1:] = 0.0 if pulls else 1.0
        self._model.body_gravcomp[self._body] = 0.0

    def set_drive_stiffness(self, stiffness: Array) -> None:
        self._stiffness = np.array(stiffness, dtype=np.float64)
        self._model.dof_damping[self._v] = JOINT_DAMPING + self.time_step * self._stiffness

    # -- state --------------------------------------------------------------------------------------

    @property
    def q(self) -> Array:
        return self._data.qpos[self._q]

    @property
    def next_q(self) -> Array:
        return self.q + self.time_step * self._data.qvel[self._v]

    @property
    def object_pose(self) -> tuple[Array, Array]:
        self._mj.mj_kinematics(self._model, self._data)
        return self._data.xpos[self._body].copy(), self._data.xmat[self._body].reshape(3, 3).copy()

    @property
    def object_speed(self) -> tuple[float, float]:
        speed = self._data.qvel[self._dofs]
        count = 3 if self._normal is None else 2
        return float(np.linalg.norm(speed[:count])), float(np.linalg.norm(speed[count:]))

    def place(self, q: Array, position: Array, rotation: Array) -> None:
        data, model = self._data, self._model
        data.qpos[self._q], data.qvel[self._v] = q, 0.0
        quaternion = self._quaternion(rotation)
        if self._normal is None:
            data.qpos[self._at : self._at + 7] = [*position, *quaternion]
        else:  # the joints count from here, along the same axes of the hand
            axes = model.jnt_axis[model.body_jntadr[self._body] :]
            before = np.zeros(9)
            self._mj.mju_quat2Mat(before, model.body_quat[self._body])
            axes[:] = axes @ before.reshape(3, 3).T @ rotation
            model.body_pos[self._body], model.body_quat[self._body] = position, quaternion
            data.qpos[self._at :] = 0.0
        data.qvel[self._dofs] = 0.0

    def hold_object(self, held: bool) -> None:
        self._model.dof_armature[self._dofs] = _FIXED if held else 0.0
        self._held = self._data.qpos[self._at :].copy() if held else None

    # -- time ---------------------------------------------------------------------------------------

    def step(self, drive_targets: Array) -> None:
        data = self._data
        data.qfrc_applied[self._v] = self._stiffness * (drive_targets - data.qpos[self._q])
        self._mj.mj_step(self._model, data)
        data.xfrc_applied[self._body] = 0.0
        if self._held is not None:
            data.qpos[self._at :], data.qvel[self._dofs] = self._held, 0.0

    def push(self, force: Array, torque: Array) -> None:
        self._data.xfrc_applied[self._body] = [*force, *torque]

    def touches(self) -> dict[str, float]:
        found: dict[str, float] = {}
        force = np.zeros(6)
        for k in range(self._data.ncon):
            self._mj.mj_contactForce(self._model, self._data, k, force)
            if force[0] > 0:
                first, second = self._data.contact[k].geom
                link = self._links[second if first in self._object_geoms else first]
                found[link] = found.get(link, 0.0) + float(force[0])
        return found

    def snapshot(self) -> bytes:
        kind = self._mj.mjtState.mjSTATE_INTEGRATION
        state = np.empty(self._mj.mj_stateSize(self._model, kind))
        self._mj.mj_getState(self._model, self._data, state, kind)
        return state.tobytes()

    def restore(self, state: bytes) -> None:
        kind = self._mj.mjtState.mjSTATE_INTEGRATION
        self._mj.mj_setState(self._model, self._data, np.frombuffer(state), kind)

    def _quaternion(self, rotation: Array) -> Array:
        """``(w, x, y, z)`` of a rotation ``(3, 3)``."""
        found = np.zeros(4)
        self._mj.mju_mat2Quat(found, np.ascontiguousarray(rotation).ravel())
        return found
