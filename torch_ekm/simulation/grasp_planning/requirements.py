"""What the pinch planner needs of a hand; the message names the pad or joint that lacks it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...description import ContactPad, HandDescription
from ...exceptions import DescriptionError
from ...kinematics import HandKinematics
from ...typing import Array
from ..mechanism.assembly import chain
from .pinch_problem import PinchProblem

_FACING = 0.3  # least cosine between a pad's direction and where it is to press; the planner wishes the same
_SAMPLES = 2048
_WIDER = np.pi / 2  # [rad] by which limits are moved to see which one is in the way


class Unmet(NamedTuple):
    """A need of the planner that a hand does not meet."""

    part: str
    """Pad or joint, by name."""
    problem: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.part}: {self.problem}; {self.remedy}"


def require_two_pads_and_limits(hand: HandDescription) -> None:
    """A pinch has two sides, and the planner draws postures from the range of each joint.

    Raises:
        DescriptionError: fewer than two pads, or a joint that moves a pad and has no limits.
    """
    if len(hand.pads) < 2:
        raise DescriptionError(
            hand.transmission_path, f"a pinch needs two [[pads]] or more, found {len(hand.pads)}"
        )
    joints = {joint for pad in hand.pads for joint in chain(hand, pad.link)}
    free = [joint for joint in sorted(joints) if not np.isfinite(hand.joint_upper - hand.joint_lower)[joint]]
    if free:
        names = ", ".join(hand.joint_names[joint] for joint in free)
        raise DescriptionError(
            hand.urdf_path, f"a pinch needs a <limit> at each joint that moves a pad, none at: {names}"
        )


def direction_unmet(hand: HandDescription, pad: ContactPad) -> Unmet | None:
    """Closing the hand must move a pad towards its ``direction``: ``d . (z_j x (x - o_j)) > 0``.

    Of the joints that move the pad, the one nearest to it that moves it along ``d`` decides. It closes the
    way a tendon pulls it; without a tendon towards its larger limit; else either way will do.
    """
    joints = chain(hand, pad.link)
    if not joints:
        return None  # part of the palm
    T, velocity, along = _motions(hand, pad)
    for joint in joints:
        if abs(along[joint]) < _FACING:
            continue
        if _closing(hand, joint) * along[joint] >= 0:
            return None
        name = hand.joint_names[joint]
        closes = (T[:3, :3].T @ (-np.sign(along[joint]) * velocity[joint])).round(4)
        return Unmet(
            f"pad '{pad.name}'",
            f"its direction {_text(pad.direction)} points away from where joint '{name}' closes it",
            f"write direction = {_text(closes / np.abs(closes).max())}, in the frame of '{pad.link}'",
        )
    return Unmet(
        f"pad '{pad.name}'",
        f"no joint moves it along its direction {_text(pad.direction)}",
        f"'direction' is the palmar side, in the frame of '{pad.link}'",
    )


def closes_pad(hand: HandDescription, pad: ContactPad) -> NDArray[np.bool_]:
    """Which joints move a pad along its direction, at rest ``(n_q,)``."""
    moves = np.isin(np.arange(hand.n_q), chain(hand, pad.link))
    return np.asarray(moves & (np.abs(_motions(hand, pad)[2]) >= _FACING))


def _motions(hand: HandDescription, pad: ContactPad) -> tuple[Array, Array, Array]:
    """Pose of a pad's link at rest, velocity of the pad as each joint turns ``(n_q, 3)``, and the cosine
    between this and its direction ``(n_q,)``."""
    kinematics, rest = HandKinematics(hand), torch.from_numpy(hand.spring_rest)
    poses = kinematics(rest)
    T = poses.of(pad.link).numpy()
    velocity = kinematics.jacobian(poses, pad.link, torch.tensor(pad.end, dtype=rest.dtype))[:3].mT.numpy()
    speed = np.linalg.norm(velocity, axis=1).clip(1e-9)
    return T, velocity, velocity @ (T[:3, :3] @ pad.direction) / speed


def unmet(problem: PinchProblem) -> list[Unmet]:
    """Everything that the pads and joints of a pinch lack, whatever the object's shape is.

    Pads must face what they press on, and some posture within the limits must bring them face to face, about
    the object's ``grasp_width`` apart. Where none does, the joint whose limits are in the way is the one that
    with wider limits lets most postures do so.
    """
    found = [lack for pad in problem.pads if (lack := direction_unmet(problem.hand, pad)) is not None]
    low, high = problem.joint_range
    if found or _opposing(problem, low, high):
        return found
    names = " and ".join(f"'{pad.name}'" for pad in problem.pads)
    width = f"{1e3 * problem.obj.grasp_width:.0f} mm apart, the object's grasp_width"
    wider = [_opposing(problem, low - _WIDER * at, high + _WIDER * at) for at in np.eye(len(low))]
    if not any(wider):
        return [Unmet(f"pads {names}", f"no posture brings them face to face, {width}", "move the fingers")]
    best = int(np.argmax(wider))
    limits = f"{np.degrees(low[best]):.0f} to {np.degrees(high[best]):.0f} deg"
    return [
        Unmet(
            f"joint '{problem.hand.joint_names[problem.moving[best]]}'",
            f"no posture within the limits brings pads {names} face to face, {width}",
            f"its limits, {limits}, are the first to be looked at",
        )
    ]


def _closing(hand: HandDescription, joint: int) -> int:
    """Sign of the joint's motion when the hand closes; 0: not known."""
    arms = hand.actuation_jacobian[[actuator.tendon for actuator in hand.actuators], joint]
    if arms.any():
        return int(np.sign(arms.sum()))
    low, high = hand.joint_lower[joint], hand.joint_upper[joint]
    return int(np.sign(low + high)) if abs(low + high) > 0.2 * (high - low) else 0


def _opposing(problem: PinchProblem, low: Array, high: Array) -> int:
    """How many of the sampled postures have the pads face to face, about a grasp width apart."""
    moving = low + np.random.default_rng(0).uniform(size=(_SAMPLES, len(low))) * (high - low)
    facing, opening = problem.opposition(problem.coupled(moving))
    width = problem.obj.grasp_width
    return int(((facing.min(axis=1) > _FACING) & (np.abs(opening - width) < 0.5 * width)).sum())


def _text(vector: object) -> str:
    return "[" + ", ".join(f"{value:.2g}" for value in np.asarray(vector, dtype=np.float64) + 0.0) + "]"
