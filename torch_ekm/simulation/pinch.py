"""Plan a pinch: fingers in equilibrium with an object between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .._extras import require
from ..description import ContactPad, HandDescription, ObjectDescription
from ..description.shape import Shape
from ..description.urdf import read_urdf
from ..exceptions import EquilibriumError, UnknownNameError
from ..kinematics import HandKinematics
from ..kinematics.se3 import exp, log
from .geometry import scaled, signed_distance
from .transmission import Transmission

Array = NDArray[np.float64]

# Preferred joint angles as parts of their range, last joint first: the thumb bent and the fingers
# nearly straight, since turning the object towards the fingers' flexion straightens the thumb.
_THUMB_BENT = (0.65, 0.3, 0.3, 0.5)
_FINGER_BENT = (0.4, 0.13, 0.12, 0.3)


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
class PinchPlan:
    """An equilibrium of hand and object, in the hand frame."""

    q: Array
    position: Array
    rotation: Array
    motor: Array
    """Motor positions that hold it ``(n_a,)`` [rad]."""
    forces: Array
    """Force of each finger on the object ``(n_pads, 3)`` [N]."""
    points: Array
    """Contact points ``(n_pads, 3)`` [m]."""
    normals: Array
    """Outward normals of the object there ``(n_pads, 3)``."""
    pads: tuple[str, ...]
    residual: float
    """Largest violation: gap / 0.1 mm, force / 10 mN, moment / 0.2 mN m, joint torque / 1 mN m."""


class PinchPlanner:
    """Least squares over posture, object pose and contact forces::

        distance_i(q, p) = 0                    each pad touches the object
        G f = w_gravity                         the object is in balance
        N^T (K_s (q - q0) + J_h^T f) = 0        so are the joints that no actuator fixes,
                                                N = null([J_a; C])
        n_thumb . f_thumb = -wanted force

    with soft wishes: forces well inside the friction cones, pads that meet the object with their
    rounded ends, joints away from their stops, tendons taut, the object where it is wanted.

    Args:
        hand, obj: the bodies.
        transmission: moment arms, springs and stiffness of the plant that will hold the object.
        gravity: in the hand frame [m/s^2].
        thumb, fingers: names of the pads that oppose each other.
        long_axis, grasp_axis: unit vectors in the object frame, along its length and through the
            faces to be held.
        mass_factor, com_shift, friction: the object of this plant.
    """

    def __init__(
        self,
        hand: HandDescription,
        obj: ObjectDescription,
        transmission: Transmission,
        gravity: tuple[float, float, float],
        thumb: str,
        fingers: tuple[str, ...],
        along: tuple[float, float, float] = (0.0, 1.0, 0.0),
        mass_factor: float = 1.0,
        com_shift: tuple[float, ...] = (0.0, 0.0, 0.0),
        friction: float = 1.0,
        object_scale: float = 1.0,
    ) -> None:
        by_name = {pad.name: pad for pad in hand.pads}
        for name in (thumb, *fingers):
            if name not in by_name:
                raise UnknownNameError("contact pad", name, by_name)
        self.hand, self.obj, self.transmission = hand, obj, transmission
        self.pads = tuple(by_name[name] for name in (thumb, *fingers))
        self.along = np.array(along, dtype=np.float64)
        self.kinematics = HandKinematics(hand)
        self._links = [self.kinematics.link_index(pad.link) for pad in self.pads]
        self._upstream = self.kinematics.upstream.numpy()[self._links]  # (n_c, n_q)
        span = hand.joint_upper - hand.joint_lower
        self._moving = np.flatnonzero(self._upstream.any(axis=0) & (span > 1e-6))
        self._tip = np.array([pad.end for pad in self.pads])
        axis = self._tip - np.array([pad.start for pad in self.pads])
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        self._axis = np.divide(axis, length, out=np.zeros_like(axis), where=length > 0)
        self._palmar = np.array([pad.direction for pad in self.pads])
        self._radius = np.array([pad.radius for pad in self.pads])
        links, self._ball, self._ball_radius = _obstacles(hand, self.pads)
        self._ball_link = [self.kinematics.link_index(name) for name in links]
        self._weight = mass_factor * obj.mass * np.array(gravity)
        self._com = obj.com + np.array(com_shift)
        self._mu = friction * obj.friction
        self._shapes = tuple(scaled(shape, object_scale) for shape in obj.shapes)
        self._prepare_mechanism()
        self._axes = _object_axes(obj)
        self._towards = self._direction_of_grasp()

    def plan(self, request: PinchRequest, start: PinchPlan | None = None) -> PinchPlan:
        """Solve for a pinch.

        Raises:
            EquilibriumError: no posture was found that holds the object as wanted.
        """
        least_squares = require("scipy.optimize").least_squares
        best = None
        for guess in self._guesses(request) if start is None else [self._guess_from(start)]:
            low, high = self._bounds()
            guess = np.clip(guess, low + 1e-9, high - 1e-9)
            found = least_squares(
                lambda x: self._residuals(x[None], request)[0],
                guess,
                jac=lambda x: self._jacobian(x, request),
                bounds=(low, high),
                x_scale="jac",
                max_nfev=200,
                ftol=1e-9,
                xtol=1e-9,
                gtol=1e-9,
            )
            violation = float(np.abs(self._equations(found.x[None], request)[0]).max())
            if best is None or (violation > 1, found.cost) < (best[1] > 1, best[2]):
                best = (found.x, violation, found.cost)
            if violation < 0.2 and found.cost < 20.0:
                break
        assert best is not None
        if best[1] > 1.0:
            raise EquilibriumError(
                "pinch planner",
                f"the best posture violates equilibrium by {best[1]:.2g} times its tolerance",
                f"the object '{self.obj.name}' may be too wide, or out of reach, for a force of "
                f"{request.force} N at along = {request.along} m",
            )
        return self._plan_of(best[0], best[1])

    def _prepare_mechanism(self) -> None:
        hand, J_a = self.hand, self.transmission.J_a
        C = hand.coupling.reshape(-1, hand.n_q)
        self._passive = _null_space(np.vstack([J_a, C])[:, self._moving])
        rest = np.setdiff1d(np.arange(hand.n_q), self._moving)
        self._follow = np.zeros((hand.n_q, len(self._moving)))  # joints that a coupling drags along
        self._follow[self._moving] = np.eye(len(self._moving))
        self._follow[rest] = -np.linalg.pinv(C[:, rest]) @ C[:, self._moving]
        free = _null_space(C) if len(C) else np.eye(hand.n_q)
        self._to_tension = np.linalg.pinv((J_a @ free).T) @ free.T
        self._pulling = np.array(
            [
                actuator.tendon and bool(J_a[k, self._moving].any())
                for k, actuator in enumerate(hand.actuators)
            ]
        )

    # -- unknowns x = [q_moving; o; phi; f_1 ... f_n] -------------------------------------------------

    def _unpack(self, x: Array) -> tuple[Array, Array, Array, Array]:
        n = len(self._moving)
        q0 = self.transmission.spring_rest
        q = q0 + (x[:, :n] - q0[self._moving]) @ self._follow.T
        rotation = exp(torch.from_numpy(x[:, n + 3 : n + 6])).numpy() @ self._nominal_rotation()
        return q, x[:, n : n + 3], rotation, x[:, n + 6 :].reshape(len(x), -1, 3)

    def _nominal_rotation(self) -> Array:
        """Long axis along the hand's wanted direction, grasp axis from the thumb to the fingers."""
        frame = np.column_stack([self.along, self._towards, np.cross(self.along, self._towards)])
        return frame @ self._axes.T

    def _direction_of_grasp(self) -> Array:
        poses = self.kinematics(torch.from_numpy(self._posture(self._preferred()))).transforms.numpy()
        tips = np.einsum("cij,cj->ci", poses[self._links, :3, :3], self._tip) + poses[self._links, :3, 3]
        across = tips[1:].mean(axis=0) - tips[0]
        across -= self.along * (self.along @ across)
        return across / np.linalg.norm(across)

    def _posture(self, moving: Array) -> Array:
        q0 = self.transmission.spring_rest
        return q0 + (moving - q0[self._moving]) @ self._follow.T

    def _preferred(self) -> Array:
        """Half-bent fingers: most at the last joint, which the pinch force bends anyway."""
        low, high = self.hand.joint_lower[self._moving], self.hand.joint_upper[self._moving]
        fraction = np.full(self.hand.n_q, 0.4)
        for pad in self.pads:
            bent = _THUMB_BENT if pad is self.pads[0] else _FINGER_BENT
            for place, joint in enumerate(_chain(self.hand, pad.link)):
                fraction[joint] = bent[min(place, 3)]
        return low + fraction[self._moving] * (high - low)

    def _bounds(self) -> tuple[Array, Array]:
        low, high = self.hand.joint_lower[self._moving], self.hand.joint_upper[self._moving]
        margin = np.minimum(0.07, 0.2 * (high - low))
        n_f = 3 * len(self.pads)
        return (
            np.concatenate([low + margin, np.full(3, -0.3), np.full(3, -1.5), np.full(n_f, -50.0)]),
            np.concatenate([high - margin, np.full(3, 0.3), np.full(3, 1.5), np.full(n_f, 50.0)]),
        )

    def _guesses(self, request: PinchRequest) -> list[Array]:
        """The preferred posture and seeded variations of it, the object between the fingertips."""
        generator = np.random.default_rng(0)
        guesses = []
        for trial in range(8):
            low, high = self.hand.joint_lower[self._moving], self.hand.joint_upper[self._moving]
            moving = self._preferred()
            if trial:
                moving = moving + generator.uniform(-0.3, 0.3, size=moving.shape) * (high - low)
            poses = self.kinematics(torch.from_numpy(self._posture(moving))).transforms.numpy()
            tips = np.einsum("cij,cj->ci", poses[self._links, :3, :3], self._tip) + poses[self._links, :3, 3]
            centre = (tips[0] + tips[1:].mean(axis=0)) / 2
            force = np.outer(np.ones(len(self.pads)), self._towards) * request.force
            force[1:] *= -1.0 / max(1, len(self.pads) - 1)
            guesses.append(np.concatenate([moving, centre, np.zeros(3), force.ravel()]))
        return guesses

    def _guess_from(self, plan: PinchPlan) -> Array:
        turn = torch.from_numpy(plan.rotation @ self._nominal_rotation().T)
        return np.concatenate([plan.q[self._moving], plan.position, log(turn).numpy(), plan.forces.ravel()])

    def _plan_of(self, x: Array, violation: float) -> PinchPlan:
        g = self._geometry(x[None])
        q = g["q"][0]
        tension = self._tension(g)[0]
        touched = (self.transmission.J_a @ self._follow).any(axis=1)
        stretch = np.where(touched, tension / self.transmission.stiffness, 0.0)
        motor = self.transmission.offset + self.transmission.J_a @ q + stretch
        return PinchPlan(
            q=q,
            position=g["o"][0],
            rotation=g["R"][0],
            motor=motor,
            forces=g["f"][0],
            points=g["point"][0],
            normals=g["n"][0],
            pads=tuple(pad.name for pad in self.pads),
            residual=violation,
        )

    def _geometry(self, x: Array) -> dict[str, Array]:
        q, o, R, f = self._unpack(x)
        poses = self.kinematics(torch.from_numpy(q))
        links = poses.transforms.numpy()[:, self._links]
        turn, origin = links[..., :3, :3], links[..., :3, 3]
        centre = origin + np.einsum("bcij,cj->bci", turn, self._tip)
        local = np.einsum("bji,bcj->bci", R, centre - o[:, None])
        distance, normal = signed_distance(self._shapes, local)
        n = np.einsum("bij,bcj->bci", R, normal)
        every = poses.transforms.numpy()[:, self._ball_link]
        ball = every[..., :3, 3] + np.einsum("bcij,cj->bci", every[..., :3, :3], self._ball)
        clearance, _ = signed_distance(self._shapes, np.einsum("bji,bcj->bci", R, ball - o[:, None]))
        return {
            "clearance": clearance - self._ball_radius,
            "facing": normal @ self._axes[:, 1],
            "q": q, "o": o, "R": R, "f": f, "n": n, "local": local, "centre": centre,
            "gap": distance - self._radius,
            "point": centre - self._radius[:, None] * n,
            "axis": np.einsum("bcij,cj->bci", turn, self._axis),
            "palmar": np.einsum("bcij,cj->bci", turn, self._palmar),
            "torque": self._contact_torque(poses, f, centre - self._radius[:, None] * n),
        }  # fmt: skip

    def _contact_torque(self, poses, f: Array, point: Array) -> Array:
        """``J_h^T f``, torque that the actuators and springs must supply ``(batch, n_q)`` [N m]."""
        axes, origins = (part.numpy() for part in self.kinematics.joint_axes(poses))
        lever = np.cross(axes[:, None], point[:, :, None] - origins[:, None])  # (b, n_c, n_q, 3)
        return np.einsum("bcqi,bci,cq->bq", lever, f, self._upstream)

    # -- residuals --------------------------------------------------------------------------------------

    def _equations(self, x: Array, request: PinchRequest, g: dict[str, Array] | None = None) -> Array:
        """What must vanish, in units of its tolerance."""
        g = self._geometry(x) if g is None else g
        force = g["f"].sum(axis=1) + self._weight
        centre = g["R"] @ self._com
        moment = np.cross(g["point"] - g["o"][:, None], g["f"]).sum(axis=1) + np.cross(centre, self._weight)
        spring = self.transmission.spring_stiffness * (g["q"] - self.transmission.spring_rest)
        passive = (spring + g["torque"])[:, self._moving] @ self._passive
        press = -np.einsum("bi,bi->b", g["f"][:, 0], g["n"][:, 0]) - request.force
        return np.concatenate(
            [g["gap"] / 1e-4, force / 0.01, moment / 2e-4, passive / 1e-3, press[:, None] / 0.1], axis=1
        )

    def _residuals(self, x: Array, request: PinchRequest) -> Array:
        g = self._geometry(x)
        f_n = -np.einsum("bci,bci->bc", g["f"], g["n"])
        f_t = np.linalg.norm(g["f"] + f_n[..., None] * g["n"], axis=-1)
        cone = np.maximum(0.0, f_t - 0.4 * self._mu * f_n) / 0.05
        share = (f_n[:, 1:] - f_n[:, :1] / max(1, len(self.pads) - 1)) / 1.0
        cap = np.maximum(0.0, 0.3 + np.einsum("bci,bci->bc", g["n"], g["axis"])) / 0.1
        pad = np.maximum(0.0, 0.3 + np.einsum("bci,bci->bc", g["n"], g["palmar"])) / 0.1
        along, across = g["local"] @ self._axes[:, 0], g["local"] @ self._axes[:, 2]
        place = [
            (along[:, 0] - request.along) / 2e-3,
            (along[:, 1:].mean(axis=1) - request.along) / 2e-3,
            (across[:, 0] - request.across) / 2e-3,
            (across[:, 1:].mean(axis=1) - request.across) / 2e-3,
        ]
        long_axis = g["R"] @ self._axes[:, 0]
        wish = self._tilted(request)
        tilt = (long_axis - wish) / 0.1
        facing = np.concatenate([-g["facing"][:, :1], g["facing"][:, 1:]], axis=1)
        opposed = np.maximum(0.0, 0.98 - facing) / 0.05
        clear = np.maximum(0.0, 0.002 - g["clearance"]) / 1e-3
        posture = (x[:, : len(self._moving)] - self._preferred()) / 0.3
        taut = np.maximum(0.0, 0.02 - self._tension(g)[:, self._pulling]) / 0.01
        hard = 3 * self._equations(x, request, g)
        wishes = [cone, share, cap, pad, np.stack(place, axis=1), tilt, opposed, clear, posture, taut]
        return np.concatenate([hard, *wishes], axis=1)

    def _tension(self, g: dict[str, Array]) -> Array:
        """Torque of each actuator along ``+a`` that balances the joints, ``(batch, n_a)`` [N m]."""
        spring = self.transmission.spring_stiffness * (g["q"] - self.transmission.spring_rest)
        return (spring + g["torque"]) @ self._to_tension.T

    def _tilted(self, request: PinchRequest) -> Array:
        third = np.cross(self.along, self._towards)
        wish = self.along + request.tilt[0] * third + request.tilt[1] * self._towards
        return wish / np.linalg.norm(wish)

    def _jacobian(self, x: Array, request: PinchRequest, step: float = 1e-6) -> Array:
        """Central differences, all columns in one batch."""
        shift = step * np.eye(len(x))
        values = self._residuals(np.concatenate([x + shift, x - shift]), request)
        return ((values[: len(x)] - values[len(x) :]) / (2 * step)).T


def _chain(hand: HandDescription, link: str) -> list[int]:
    """Joints that move a link, the nearest first."""
    urdf = hand.urdf if hand.urdf is not None else read_urdf(hand.urdf_path)
    above = {joint.child: joint for joint in urdf.joints}
    chain = []
    while link in above:
        if above[link].name in hand.joint_names:
            chain.append(hand.joint_names.index(above[link].name))
        link = above[link].parent
    return chain


def _obstacles(hand: HandDescription, pads: tuple[ContactPad, ...]) -> tuple[list[str], Array, Array]:
    """Balls that stand for the solid parts of the hand, the pads' rounded ends left out.

    Returns the link of each ball, its centre in that link ``(n, 3)`` [m] and its radius ``(n,)`` [m].
    """
    urdf = hand.urdf if hand.urdf is not None else read_urdf(hand.urdf_path)
    links, centres, radii = [], [], []

    def add(link: str, centre: Array, radius: float) -> None:
        links.append(link)
        centres.append(centre)
        radii.append(radius)

    carrying = {pad.link: pad for pad in pads}
    for link in urdf.links:
        if link.name in carrying:
            add(link.name, np.array(carrying[link.name].start), carrying[link.name].radius)
            continue
        for shape in link.collisions:
            rotation, origin = shape.transform[:3, :3], shape.transform[:3, 3]
            if shape.kind == "box":
                half = np.array(shape.size) / 2
                for corner in np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * 3), axis=-1).reshape(-1, 3):
                    if np.abs(corner).max() == 1:
                        add(link.name, origin + rotation @ (half * corner), 0.0)
            elif shape.kind == "sphere":
                add(link.name, origin, shape.size[0])
            else:
                for part in (-0.5, 0.0, 0.5):
                    add(link.name, origin + part * shape.size[1] * rotation[:, 2], shape.size[0])
    return links, np.array(centres), np.array(radii)


def _null_space(matrix: Array, tolerance: float = 1e-9) -> Array:
    _, singular, vt = np.linalg.svd(matrix)
    return vt[int((singular > tolerance).sum()) :].T


def _object_axes(obj: ObjectDescription) -> Array:
    """Columns: the longest direction across the grasp axis, the grasp axis, and their product."""
    grasp = obj.grasp_axis / np.linalg.norm(obj.grasp_axis)
    helper = np.eye(3)[np.argmin(np.abs(grasp))]
    first = np.cross(helper, grasp)
    first /= np.linalg.norm(first)
    extents = {}
    for axis in (first, np.cross(grasp, first)):
        reach = [_half_extent(shape, axis) for shape in obj.shapes]
        extents[max(reach)] = axis
    long_axis = extents[max(extents)]
    return np.column_stack([long_axis, grasp, np.cross(long_axis, grasp)])


def _half_extent(shape: Shape, axis: Array) -> float:
    local = np.abs(shape.transform[:3, :3].T @ axis)
    centre = abs(float(shape.transform[:3, 3] @ axis))
    if shape.kind == "box":
        return centre + float(local @ np.array(shape.size)) / 2
    if shape.kind == "sphere":
        return centre + shape.size[0]
    radius, length = shape.size
    return centre + float(local[2]) * length / 2 + radius
