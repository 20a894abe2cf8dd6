"""The equations of a pinch: fingers in equilibrium with an object between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..._arrays import null_space
from ...contact import signed_distance
from ...description import HandDescription, ObjectDescription
from ...exceptions import UnknownNameError
from ...kinematics import HandKinematics
from ...kinematics.equilibrium import FreeHand
from ...kinematics.se3 import cross, exp
from ...typing import Array
from ..mechanism.assembly import chain
from ..mechanism.transmission import Transmission
from .graspable import object_axes, obstacles, opposition

# Preferred joint angles as parts of their range, last joint first: the thumb bent and the fingers
# nearly straight, since turning the object towards the fingers' flexion straightens the thumb.
_THUMB_BENT = (0.65, 0.3, 0.3, 0.5)
_FINGER_BENT = (0.4, 0.13, 0.12, 0.3)
_ROOM = 0.02  # [rad] between a motor and the ends of its range
_PULLS = 1e-9  # [1] arm of a motor that moves a pinch; less is what rounding leaves
_CLEAR = 0.002  # [m] that other parts of the hand keep from the object


@dataclass(frozen=True)
class PinchRequest:
    """What is wanted of a pinch. Lengths [m], angles [rad], in the object frame."""

    force: float = 5.0
    """Normal force of the thumb [N]; the fingers share its reaction."""
    along: float = 0.0
    """Where on the object's long axis the fingers are centred [m]."""
    across: float = 0.0
    """Where on the object's other lateral axis [m]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Turn of the long axis away from the hand's wanted direction, about the two other axes."""


@dataclass(frozen=True)
class PinchGeometry:
    """A batch of candidate pinches, in the hand frame; ``b`` candidates, ``c`` contacts."""

    q: Array
    position: Array
    rotation: Array
    force: Array
    """Of each finger on the object ``(b, c, 3)`` [N]."""
    gap: Array
    """Between pad and object ``(b, c)`` [m]."""
    normal: Array
    """Outward normals of the object ``(b, c, 3)``."""
    point: Array
    """Contact points ``(b, c, 3)`` [m]."""
    local: Array
    """Centres of the pads' rounded ends in the object frame ``(b, c, 3)`` [m]."""
    facing: Array
    """Component of the normals along the object's grasp axis ``(b, c)``."""
    pad_axis: Array
    pad_direction: Array
    clearance: Array
    """Between the object and the other parts of the hand ``(b, n)`` [m]."""
    torque: Array
    """``J_h^T f``: what springs and actuators must supply ``(b, n_q)`` [N m]."""


@dataclass(eq=False)
class PinchProblem:
    """Residuals over posture, object pose and contact forces, ``x = [q_moving; o; phi; f_1 ...]``::

        distance_i(q, p) = 0                    each pad touches the object
        G f = -w_gravity                        the object is in balance
        N^T (K_s (q - q0) + J_h^T f) = 0        so are the joints that no actuator fixes,
                                                N = null([J_a; C; dc/dq])
        C (q - q0) = 0, c(q) = 0                couplings hold, loops close
        -n_thumb . f_thumb = wanted force

    with soft wishes: forces well inside the friction cones, pads that meet the object with their
    rounded ends, joints away from their stops, tendons taut, the object where it is wanted, and if asked
    for motors within their ranges.

    Raises:
        UnknownNameError: there is no such pad; the message lists all.
    """

    hand: HandDescription
    obj: ObjectDescription
    """The bodies as they really are."""
    transmission: Transmission
    """Moment arms, springs and stiffness of the plant that will hold the object."""
    thumb: str
    fingers: tuple[str, ...]
    """Names of the pads that oppose each other."""
    along: Array
    """Wanted direction of the object's long axis, in the hand frame."""

    def __post_init__(self) -> None:
        hand, obj = self.hand, self.obj
        by_name = {pad.name: pad for pad in hand.pads}
        for name in (self.thumb, *self.fingers):
            if name not in by_name:
                raise UnknownNameError("contact pad", name, by_name)
        self.pads = tuple(by_name[name] for name in (self.thumb, *self.fingers))
        self.kinematics = HandKinematics(hand)
        self._links = [self.kinematics.link_index(pad.link) for pad in self.pads]
        self._upstream = self.kinematics.upstream.numpy()[self._links]  # (n_c, n_q)
        span = hand.joint_upper - hand.joint_lower
        moved = np.asarray(self._upstream.any(axis=0), dtype=bool)
        self.moving = np.flatnonzero(self._with_loops(moved) & (span > 1e-6))
        self.joint_range = (hand.joint_lower[self.moving], hand.joint_upper[self.moving])
        self._tip = np.array([pad.end for pad in self.pads])
        axis = self._tip - np.array([pad.start for pad in self.pads])
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        self._axis = np.divide(axis, length, out=np.zeros_like(axis), where=length > 0)
        self._palmar = np.array([pad.direction for pad in self.pads])
        self._radius = np.array([pad.radius for pad in self.pads])
        links, self._ball, self._ball_radius = obstacles(hand, self.pads)
        self.obstacle_links = links
        """Link of each part whose clearance counts."""
        self._ball_link = np.array([self.kinematics.link_index(name) for name in links], dtype=np.int64)
        self._prepare_mechanism()
        self.axes = object_axes(obj)
        """Of the object, as columns: long axis, grasp axis, their product."""
        self.preferred = self._half_bent()
        """Half-bent fingers: most at the last joint, which the pinch force bends anyway."""
        tips = self.tips(self.preferred)
        across = tips[1:].mean(axis=0) - tips[0]
        across -= self.along * (self.along @ across)
        self.towards: Array = across / np.linalg.norm(across)
        self._third = np.cross(self.along, self.towards)
        # long axis along the hand's wanted direction, grasp axis from the thumb to the fingers
        self._nominal = np.column_stack([self.along, self.towards, self._third]) @ self.axes.T

    def _prepare_mechanism(self) -> None:
        hand, J_a = self.hand, self.transmission.J_a
        C = hand.coupling.reshape(-1, hand.n_q)
        closed = np.zeros((0, hand.n_q)) if hand.loops is None else hand.loops.lengths.typical
        closed = closed / np.linalg.norm(closed, axis=1, keepdims=True)
        self._passive = null_space(np.vstack([J_a, C, closed])[:, self.moving])
        rest = np.setdiff1d(np.arange(hand.n_q), self.moving)
        self.follow = np.zeros((hand.n_q, len(self.moving)))  # joints that a coupling drags along
        self.follow[self.moving] = np.eye(len(self.moving))
        self.follow[rest] = -np.linalg.pinv(C[:, rest]) @ C[:, self.moving]
        ties = C @ self.follow
        tied = np.abs(ties).max(axis=1, initial=0.0) > _PULLS  # couplings of moving joints with one another
        self._ties, self._untied = C[tied], null_space(ties[tied])
        self._free = free = null_space(C)
        self._constant = hand.lengths.constant and hand.loops is None
        self._to_tension = np.linalg.pinv((J_a @ free).T) @ free.T
        tendon = np.array([actuator.tendon for actuator in hand.actuators], dtype=bool)
        self.in_use: NDArray[np.bool_] = np.abs(J_a @ self.follow).max(axis=1, initial=0.0) > _PULLS
        self._pulling = tendon & J_a[:, self.moving].any(axis=1)
        self._rest()

    def _with_loops(self, moving: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """These joints, and those that move with them through loops."""
        if (loops := self.hand.loops) is not None:
            ties = loops.lengths.typical != 0
            for _ in ties:
                moving = moving | ties[ties @ moving].any(axis=0)
        return moving

    def _rest(self) -> None:
        """Where idle joints are: springs at rest, or at stops where their motors let them be slack."""
        hand, T = self.hand, self.transmission
        self._q0 = q0 = T.spring_rest.copy()
        idle = np.setdiff1d(np.flatnonzero(~self.follow.any(axis=1)), self.moving)
        stopped = np.clip(q0, hand.joint_lower, hand.joint_upper)
        slack = T.offset + T.length(stopped)
        motor = np.where(self.in_use, slack, self._within(slack))
        if (q0 != stopped)[idle].any() or (slack != motor).any():
            q0[idle] = FreeHand(hand)(motor + hand.actuator_offset - T.offset).q[idle]

    def _within(self, motor: Array) -> Array:
        """The nearest positions in the motors' ranges."""
        return np.clip(motor, self.hand.actuator_lower, self.hand.actuator_upper)

    def tips(self, moving: Array) -> Array:
        """Centres of the pads' rounded ends ``(*batch, c, 3)`` [m]."""
        poses = self._pad_poses(moving)
        return np.einsum("...cij,cj->...ci", poses[..., :3, :3], self._tip) + poses[..., :3, 3]

    def opposition(self, moving: Array) -> tuple[Array, Array]:
        """How well the pads face each other, cosines ``(b, c)``, and their distance ``(b,)`` [m]."""
        turns = self._pad_poses(moving)[..., :3, :3]
        directions = np.einsum("...cij,cj->...ci", turns, self._palmar)
        facing, distance = opposition(self.tips(moving), directions)
        return facing, distance - self._radius[0] - self._radius[1:].mean()

    def _pad_poses(self, moving: Array) -> Array:
        poses = self.kinematics(torch.from_numpy(self.posture(moving))).transforms.numpy()
        return poses[..., self._links, :, :]

    def posture(self, moving: Array) -> Array:
        """All joints, coupled ones following, others at rest ``(*batch, n_q)`` [rad]."""
        q0 = self._q0
        return q0 + (moving - q0[self.moving]) @ self.follow.T

    def _half_bent(self) -> Array:
        low, high = self.joint_range
        fraction = np.full(self.hand.n_q, 0.4)
        for pad in self.pads:
            bent = _THUMB_BENT if pad is self.pads[0] else _FINGER_BENT
            for place, joint in enumerate(chain(self.hand, pad.link)):
                fraction[joint] = bent[min(place, 3)]
        return self.coupled(low + fraction[self.moving] * (high - low))

    def coupled(self, moving: Array) -> Array:
        """The nearest postures that couplings allow, whatever the limits ``(*batch, n_moving)`` [rad]."""
        if not len(self._ties):
            return moving
        q0 = self._q0[self.moving]
        return q0 + (moving - q0) @ self._untied @ self._untied.T

    def geometry(self, x: Array, near: NDArray[np.intp] | None = None) -> PinchGeometry:
        """Forward kinematics and distances of a batch of candidates ``(b, n_x)``.

        ``near``: numbers of the other parts whose clearance is asked; that of the rest is infinite. Hands of
        many boxes are planned for in a quarter of the time.
        """
        near = np.arange(len(self._ball)) if near is None else near
        n, placed = len(self.moving), len(self.moving) + 6  # unknowns before pose, and before forces
        q, o = self.posture(x[:, :n]), x[:, n : n + 3]
        R = exp(torch.from_numpy(x[:, n + 3 : placed])).numpy() @ self._nominal
        poses = self.kinematics(torch.from_numpy(q))
        transforms = poses.transforms.numpy()
        links = transforms[:, self._links]
        turn, origin = links[..., :3, :3], links[..., :3, 3]
        centre = origin + np.einsum("bcij,cj->bci", turn, self._tip)
        local = np.einsum("bji,bcj->bci", R, centre - o[:, None])
        distance, outward = signed_distance(self.obj.shapes, local)
        normal = np.einsum("bij,bcj->bci", R, outward)
        every = transforms[:, self._ball_link[near], :3]
        ball = every[..., 3] + np.einsum("bcij,cj->bci", every[..., :3], self._ball[near])
        apart, _ = signed_distance(self.obj.shapes, np.einsum("bji,bcj->bci", R, ball - o[:, None]))
        clearance = np.full((len(x), len(self._ball)), np.inf)
        clearance[:, near] = apart - self._ball_radius[near]
        point = centre - self._radius[:, None] * normal
        f = x[:, placed:].reshape(len(x), -1, 3)
        axes, origins = (part.numpy() for part in self.kinematics.joint_axes(poses))
        lever = cross(axes[:, None], point[:, :, None] - origins[:, None])  # (b, n_c, n_q, 3)
        return PinchGeometry(
            q=q,
            position=o,
            rotation=R,
            force=f,
            gap=distance - self._radius,
            normal=normal,
            point=point,
            local=local,
            facing=outward @ self.axes[:, 1],
            pad_axis=np.einsum("bcij,cj->bci", turn, self._axis),
            pad_direction=np.einsum("bcij,cj->bci", turn, self._palmar),
            clearance=clearance,
            torque=np.einsum("bcqi,bci,cq->bq", lever, f, self._upstream),
        )

    # -- residuals --------------------------------------------------------------------------------------

    def equations(self, request: PinchRequest, g: PinchGeometry) -> Array:
        """What must vanish, in units of its tolerance."""
        weight = self.obj.mass * np.array(self.hand.gravity)
        force = g.force.sum(axis=1) + weight
        centre = g.rotation @ self.obj.com
        moment = cross(g.point - g.position[:, None], g.force).sum(axis=1) + cross(centre, weight)
        passive = self._unheld(g)[:, self.moving] @ self._passive
        press = -np.einsum("bi,bi->b", g.force[:, 0], g.normal[:, 0]) - request.force
        parts = [g.gap / 1e-4, force / 0.01, moment / 2e-4, passive / 1e-3, press[:, None] / 0.1]
        parts.append((g.q - self._q0) @ self._ties.T / 1e-4)
        if (loops := self.hand.loops) is not None:
            parts.append(loops.gap(g.q) / (1e-4 * np.linalg.norm(loops.lengths.typical, axis=1)))
        return np.concatenate(parts, axis=1)

    def residuals(
        self, x: Array, request: PinchRequest, ranges: bool, near: NDArray[np.intp] | None = None
    ) -> Array:
        """Equations and wishes ``(b, n_r)``, to be squared and summed.

        Args:
            ranges: wish that the motors keep to theirs.
            near: as of :meth:`geometry`.
        """
        g = self.geometry(x, near)
        f_n = -np.einsum("bci,bci->bc", g.force, g.normal)
        f_t = np.linalg.norm(g.force + f_n[..., None] * g.normal, axis=-1)
        cone = np.maximum(0.0, f_t - 0.4 * self.obj.friction * f_n) / 0.05
        share = (f_n[:, 1:] - f_n[:, :1] / max(1, len(self.pads) - 1)) / 1.0
        cap = np.maximum(0.0, 0.3 + np.einsum("bci,bci->bc", g.normal, g.pad_axis)) / 0.1
        pad = np.maximum(0.0, 0.3 + np.einsum("bci,bci->bc", g.normal, g.pad_direction)) / 0.1
        along, across = g.local @ self.axes[:, 0], g.local @ self.axes[:, 2]
        place = [
            (part - wanted) / 2e-3
            for at, wanted in ((along, request.along), (across, request.across))
            for part in (at[:, 0], at[:, 1:].mean(axis=1))
        ]
        long_axis = g.rotation @ self.axes[:, 0]
        wish = self.along + request.tilt[0] * self._third + request.tilt[1] * self.towards
        tilt = (long_axis - wish / np.linalg.norm(wish)) / 0.1
        facing = np.concatenate([-g.facing[:, :1], g.facing[:, 1:]], axis=1)
        opposed = np.maximum(0.0, 0.98 - facing) / 0.05
        clear = np.maximum(0.0, _CLEAR - g.clearance) / 1e-3
        posture = (x[:, : len(self.moving)] - self.preferred) / 0.3
        taut = np.maximum(0.0, 0.02 - self.tension(g)[:, self._pulling]) / 0.01
        hard = 3 * self.equations(request, g)
        wishes = [cone, share, cap, pad, np.stack(place, axis=1), tilt, opposed, clear, posture, taut]
        if ranges:
            wishes.append(np.maximum(0.0, self.outside(g) + _ROOM) / 0.01)
        return np.concatenate([hard, *wishes], axis=1)

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest ``x``; joints keep off their stops."""
        low, high = self.joint_range
        margin = np.minimum(0.07, 0.2 * (high - low))
        rest = np.concatenate([np.full(3, 0.3), np.full(3, 1.5), np.full(3 * len(self.pads), 50.0)])
        return np.concatenate([low + margin, -rest]), np.concatenate([high - margin, rest])

    def motors(self, g: PinchGeometry) -> Array:
        """Motor positions that hold the candidates ``(b, n_a)`` [rad]; idle ones rest."""
        T = self.transmission
        stretch = T.stretched(np.where(self.in_use, self.tension(g), 0.0))
        inner = g.q + T.lean(g.torque)
        motor = T.offset + T.length(inner) + stretch
        return np.where(self.in_use, motor, self._within(motor))

    def outside(self, g: PinchGeometry) -> Array:
        """How far each motor in use is beyond its range ``(b, n)`` [rad]; negative: inside."""
        motor = self.motors(g)
        return np.maximum(self.hand.actuator_lower - motor, motor - self.hand.actuator_upper)[:, self.in_use]

    def tension(self, g: PinchGeometry) -> Array:
        """Torque of each actuator along ``+a`` that balances the joints, ``(batch, n_a)`` [N m]."""
        load = self.joint_load(g)
        if self._constant:
            return load @ self._to_tension.T
        return self._reactions(g, load)[0][:, : self.hand.n_a]

    def _unheld(self, g: PinchGeometry) -> Array:
        """What of the joint load neither actuators nor loops nor couplings bear ``(batch, n_q)`` [N m]."""
        load = self.joint_load(g)
        if self._constant:
            return load  # the passive motions are at right angles to all that is borne
        found, rows = self._reactions(g, load)
        return (load @ self._free - (found[:, None] @ rows)[:, 0]) @ self._free.T

    def off_balance(self, g: PinchGeometry) -> Array:
        """Torques that neither actuators nor loops nor couplings bear ``(batch, n_q)`` [N m]."""
        off = np.zeros_like(g.torque)
        off[:, self.moving] = self._unheld(g)[:, self.moving] @ self._passive @ self._passive.T
        return off

    def passive_share(self, joint: int) -> float:
        """How much of a torque at one joint nothing bears, 0 to 1."""
        return float(np.square(self._passive[self.moving == joint]).sum())

    def slack(self, g: PinchGeometry) -> list[str]:
        """Tendons that would have to push, by name."""
        pushed = self._pulling & (self.tension(g)[0] < 0)
        return [name for name, chosen in zip(self.hand.actuator_names, pushed, strict=True) if chosen]

    def _reactions(self, g: PinchGeometry, load: Array) -> tuple[Array, Array]:
        """Forces of actuators and loops ``(batch, n)`` and their rows ``(batch, n, n_free)``."""
        rows = self.transmission.arms(g.q)
        if (loops := self.hand.loops) is not None:
            closed = loops.lengths.jacobian(g.q)
            rows = np.concatenate([np.broadcast_to(rows, (len(closed), *rows.shape[-2:])), closed], axis=1)
        rows = rows @ self._free
        found = np.linalg.pinv(rows.swapaxes(-1, -2), rcond=1e-9) @ (load @ self._free)[..., None]
        return found[..., 0], rows

    def joint_load(self, g: PinchGeometry) -> Array:
        """What springs and contacts ask of the tendons, for moment arms J_a, ``(batch, n_q)`` [N m]."""
        T = self.transmission
        inner = g.q + T.lean(g.torque)
        return (T.spring_torque(inner) + g.torque) / T.shape.arm(inner)

    def jacobian(self, x: Array, request: PinchRequest, ranges: bool) -> Array:
        """Of :meth:`residuals`, central differences, all columns in one batch.

        Parts that are clear of the object stay so in a step.
        """
        step = 1e-6
        shift = step * np.eye(len(x))
        near = np.flatnonzero(self.geometry(x[None]).clearance[0] < 2 * _CLEAR)
        values = self.residuals(np.concatenate([x + shift, x - shift]), request, ranges, near)
        return ((values[: len(x)] - values[len(x) :]) / (2 * step)).T
