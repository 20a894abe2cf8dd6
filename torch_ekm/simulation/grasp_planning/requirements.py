"""What the pinch planner needs of a hand; the message names the pad or joint that lacks it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...description import ContactPad, HandDescription
from ...exceptions import DescriptionError
from ...kinematics import HandKinematics
from ...typing import Array
from ..mechanism.assembly import chain

_FACING = 0.3  # least cosine between a pad's direction and where it is to press; the planner wishes the same


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


def direction_unmet(hand: HandDescription, pad: ContactPad) -> tuple[str, str] | None:
    """Closing the hand must move a pad towards its ``direction``: ``d . (z_j x (x - o_j)) > 0``.

    Of the joints that move the pad, the one nearest to it that moves it along ``d`` decides. It closes the
    way a tendon pulls it; without a tendon towards its larger limit; else either way will do.

    Returns:
        What is wrong, and the remedy; None: nothing is.
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
        return (
            f"its direction {_text(pad.direction)} points away from where joint '{name}' closes it",
            f"write direction = {_text(closes / np.abs(closes).max())}, in the frame of '{pad.link}'",
        )
    return (
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


def _closing(hand: HandDescription, joint: int) -> int:
    """Sign of the joint's motion when the hand closes; 0: not known."""
    arms = hand.actuation_jacobian[[actuator.tendon for actuator in hand.actuators], joint]
    if arms.any():
        return int(np.sign(arms.sum()))
    low, high = hand.joint_lower[joint], hand.joint_upper[joint]
    return int(np.sign(low + high)) if abs(low + high) > 0.2 * (high - low) else 0


def _text(vector: object) -> str:
    return "[" + ", ".join(f"{value:.2g}" for value in np.asarray(vector, dtype=np.float64) + 0.0) + "]"
