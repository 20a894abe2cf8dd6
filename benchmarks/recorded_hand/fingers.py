"""Where the markers of a planar hand of two-joint fingers sit, and where its camera is: in closed form.

A proximal marker runs on a circle about the base joint, a distal one on a circle about the second joint, and
a finger that touches a cylinder of known diameter determines the angle at which its distal marker sits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from torch_ekm._extras import require
from torch_ekm.description import HandDescription
from torch_ekm.exceptions import CalibrationError, ParameterError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.typing import Array

_DISTANCE_STD = 0.5e-3  # [m] of a marker's distance from its joint, in the identification
_GAP_STD = 1e-3  # [m] between pad and cylinder
_ANGLE_STD = 0.2  # [rad] markers sit about on the middle of their links
_FRAMES = 1500  # of a recording, for the identification
_ITERATIONS = 20  # of Gauss-Newton, for all frames
_CAMERA_STD = (0.02, 0.003, 0.008)  # [rad, m, m]: how far it may have moved between recordings
_SEEN_STD = 1e-3  # [m] of a marker's distance from its joint, in the registration: noise and play of a joint


class PlanarFingers:
    """Fingers of two joints in the plane z = 0 of the hand frame, as the description has them.

    Raises:
        ParameterError: the hand has other joints than two fingers' ``left_0, left_1, right_0, right_1``.
    """

    def __init__(self, hand: HandDescription) -> None:
        names = ("left_0", "left_1", "right_0", "right_1")
        if hand.joint_names != names or hand.planar_normal is None:
            raise ParameterError("hand", hand.name, f"a planar hand with the joints {', '.join(names)}")
        self.hand = hand
        kinematics = HandKinematics(hand)
        poses = kinematics(torch.zeros(4, dtype=torch.float64))
        axis, origin = (part.numpy() for part in kinematics.joint_axes(poses))
        self.sign = axis[::2, 2]
        self.base = origin[::2, :2]
        self.length = np.linalg.norm(origin[1::2] - origin[::2], axis=1)
        self.start = np.array([pad.start[:2] for pad in hand.pads])
        self.end = np.array([pad.end[:2] for pad in hand.pads])
        self.radius = np.array([pad.radius for pad in hand.pads])

    def read(self, seen: Array, polar: Array, camera: Array) -> tuple[Array, Array]:
        """Joint angles ``(n, 4)`` [rad] and what the distances marker to joint are off ``(n, 4)`` [m].

        Args:
            seen: ``(n, 4, 2)`` [m], markers in the order of their links, left_0, right_0, left_1, right_1.
            polar: distance [m] and angle [rad] of each marker in its link ``(4, 2)``.
            camera: ``y = R(phi) x + t``: phi, t ``(3,)``.
        """
        x = (seen - camera[1:]) @ rotation(camera[0])
        q, off = np.empty((len(x), 4)), np.empty((len(x), 4))
        for f, sign in enumerate(self.sign):
            arm = x[:, f] - self.base[f]
            off[:, f] = np.linalg.norm(arm, axis=1) - polar[f, 0]
            first = np.arctan2(arm[:, 1], arm[:, 0]) - polar[f, 1]
            joint = self.base[f] + self.length[f] * _direction(first)
            arm = x[:, 2 + f] - joint
            off[:, 2 + f] = np.linalg.norm(arm, axis=1) - polar[2 + f, 0]
            second = np.arctan2(arm[:, 1], arm[:, 0]) - polar[2 + f, 1]
            q[:, 2 * f] = _wrapped(sign * (first - math.pi / 2))
            q[:, 2 * f + 1] = _wrapped(sign * (second - first))
        return q, off

    def distance(self, q: Array, position: Array) -> Array:
        """From the surface of each pad to a point ``(n, 2)`` [m]; NaN where an angle is."""
        found = np.empty((len(q), 2))
        for f, sign in enumerate(self.sign):
            first = math.pi / 2 + sign * q[:, 2 * f]
            second = first + sign * q[:, 2 * f + 1]
            joint = self.base[f] + self.length[f] * _direction(first)
            local = np.einsum("ni,nij->nj", position - joint, rotation(second))
            span = self.end[f] - self.start[f]
            share = np.clip((local - self.start[f]) @ span / max(span @ span, 1e-18), 0, 1)
            found[:, f] = (
                np.linalg.norm(local - self.start[f] - share[:, None] * span, axis=1) - self.radius[f]
            )
        return found


@dataclass(frozen=True)
class FingerMarkers:
    """Where markers sit in their links, and where the camera is."""

    fingers: PlanarFingers
    polar: Array
    """Distance [m] and angle [rad] of each marker in its link ``(4, 2)``."""
    camera: Array
    """phi [rad], t [m] of ``y = R(phi) x + t`` ``(3,)``."""
    noise: float
    """Standard deviation of a marker's coordinate [m]."""

    def joints(self, seen: Array) -> tuple[Array, Array]:
        """``min_q |x(q) - x|^2 / sigma^2 + |(q - middle)/spread|^2``: joint angles and their standard
        deviations ``(n, 4)`` [rad], of the noise of the markers, not of what all frames share.

        A weak prior, uniform over each joint's range, stands in where markers are missing.

        Args:
            seen: ``(n, 4, 2)`` [m]; NaN: not seen.
        """
        fingers, x = self.fingers, (seen - self.camera[1:]) @ rotation(self.camera[0])
        lower, upper = fingers.hand.joint_lower.clip(-math.pi), fingers.hand.joint_upper.clip(max=math.pi)
        middle, spread = (lower + upper) / 2, (upper - lower) / math.sqrt(12)
        q, std = np.tile(middle, (len(x), 1)), np.empty((len(x), 4))
        for f, sign in enumerate(fingers.sign):
            own = [2 * f, 2 * f + 1]
            (near, at_near), (far, at_far) = self.polar[f], self.polar[2 + f]
            for _ in range(_ITERATIONS):
                first = math.pi / 2 + sign * q[:, own[0]]
                second = first + sign * q[:, own[1]]
                link, end = fingers.length[f] * _direction(first), far * _direction(second + at_far)
                places = [near * _direction(first + at_near), link + end]
                miss = np.hstack(
                    [x[:, f + 2 * k] - fingers.base[f] - place for k, place in enumerate(places)]
                )
                J = np.zeros((len(x), 4, 2))
                J[:, :, 0], J[:, 2:, 1] = np.hstack([_across(place) for place in places]), _across(end)
                J *= sign
                J_w = (J * (np.isfinite(miss) / self.noise**2)[..., None]).transpose(0, 2, 1)
                information = J_w @ J + np.diag(spread[own] ** -2)
                right = (J_w @ np.nan_to_num(miss)[..., None])[..., 0] + (middle - q)[:, own] / spread[
                    own
                ] ** 2
                q[:, own] += np.linalg.solve(information, right[..., None])[..., 0].clip(-0.5, 0.5)
            std[:, own] = np.sqrt(np.linalg.inv(information).diagonal(axis1=1, axis2=2))
        return q, std


def identify_markers(hand: HandDescription, markers: Array, pose: Array, diameter: float) -> FingerMarkers:
    """``min sum (|m - joint| - r)^2 / s_r^2 + (gap - d/2)^2 / s_g^2`` over markers (r, alpha) and camera.

    Args:
        hand: a planar hand of two fingers.
        markers: ``(n, 4, 2)`` [m], NaN where not seen.
        pose: of a cylinder that both pads touch: x, y [m], angle ``(n, 3)``.
        diameter: of the cylinder [m].

    Raises:
        CalibrationError: in fewer than 20 frames all markers are seen.
    """
    fingers = PlanarFingers(hand)
    whole = np.flatnonzero(np.isfinite(markers).all((1, 2)))
    if len(whole) < 20:
        raise CalibrationError("finger markers", f"all four are seen in {len(whole)} frames; 20 are needed")
    whole = whole[:: max(1, len(whole) // _FRAMES)]
    seen, position = markers[whole], pose[whole, :2]

    def parts(v: Array) -> tuple[Array, Array]:
        return v[:8].reshape(4, 2), v[8:]

    def residual(v: Array) -> Array:
        polar, camera = parts(v)
        q, off = fingers.read(seen, polar, camera)
        gap = fingers.distance(q, (position - camera[1:]) @ rotation(camera[0])) - diameter / 2
        scaled = [off / _DISTANCE_STD, gap / _GAP_STD, polar[:, 1] / _ANGLE_STD]
        return np.concatenate([part.ravel() for part in scaled])

    middle = np.nanmedian(markers, axis=0)
    start = [fingers.length.mean(), 0.0] * 2 + [0.3 * fingers.length.mean(), 0.0] * 2
    between = 0.5 * (middle[0] + middle[1])
    start += [0.0, between[0], between[1] - fingers.length.mean()]
    fit = require("scipy.optimize").least_squares(residual, start, loss="soft_l1", x_scale="jac")
    polar, camera = parts(fit.x)
    _, off = fingers.read(seen, polar, camera)
    noise = float(np.sqrt(np.mean(off**2)))
    return FingerMarkers(fingers, polar, camera, noise)


def register_camera(markers: FingerMarkers, seen: Array) -> FingerMarkers:
    """The same markers, the camera where it was in another recording, from its frames ``(n, 4, 2)``.

    Distances of markers from their joints are what is measured; where the camera was before is a prior, since
    the fingers of a few frames point about the same way.
    """
    before = markers.camera

    def residual(camera: Array) -> Array:
        _, off = markers.fingers.read(seen, markers.polar, camera)
        return np.concatenate([off[np.isfinite(off)] / _SEEN_STD, (camera - before) / _CAMERA_STD])

    fit = require("scipy.optimize").least_squares(residual, before, loss="soft_l1", x_scale=_CAMERA_STD)
    return replace(markers, camera=fit.x)


def _direction(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _across(arm: Array) -> Array:
    """Turned by a right angle: the derivative by the angle of an arm."""
    return np.stack([-arm[..., 1], arm[..., 0]], axis=-1)


def rotation(angle: Array | float) -> Array:
    """``R(angle)``, ``(*batch, 2, 2)``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _wrapped(angle: Array) -> Array:
    return (angle + math.pi) % (2 * math.pi) - math.pi
