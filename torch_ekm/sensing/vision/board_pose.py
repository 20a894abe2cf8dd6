"""Pose of one marker board from its corners in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..._extras import require
from ...kinematics.se3 import hat
from ...typing import Array
from .camera import PinholeCamera

_CORNER_STD = 0.20  # of one coordinate of a detected corner [px]
_MAX_RESIDUAL = 1.0  # a corner farther than this from the fitted board is left out [px]
_MIN_CORNERS = 6  # fewer do not make a pose


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Pose of a board in the camera frame, and how well the corners determine it."""

    rotation: Array
    """Board frame to camera frame, ``(3, 3)``."""
    position: Array
    """Centre of the card ``(3,)`` [m]."""
    covariance: Array
    """Of the twist ``(v; w)`` of the card about its centre, camera axes, ``(6, 6)`` [m, rad]."""
    ambiguous: bool
    """Another pose explains the image as well; ``prior`` decided, if one was given."""
    mirror: tuple[Array, Array] | None = None
    """Rotation and position of the other local minimum, unless it is clearly worse."""


def estimate_board_pose(
    camera: PinholeCamera, object_points: Array, image_points: Array, prior: Array | None = None
) -> BoardPose | None:
    r"""``min_{R, t} sum_i |u_i - pi(R X_i + t)|^2`` over the corners that agree.

    A planar target has two local minima, mirrored about the line of sight. Both are computed in
    closed form (IPPE, Collins and Bartoli, IJCV 2014) and refined by Levenberg-Marquardt; the
    better one counts, and the other is kept as ``mirror`` unless it is worse by a hundred units of
    ``chi^2 = sum r^2 / sigma_c^2``, ``sigma_c = 0.2 px`` of a corner. Where it is worse by less than
    nine and the two differ by more than 10 deg the result is ``ambiguous``, and the one nearer to
    ``prior`` is taken.

    Corners farther than 1 px from the fit, or than four robust deviations, are left
    out, the worst first (a corner half hidden by a finger is found, but at a wrong place).

    The covariance is ``sigma^2 (J^T J)^-1`` with ``sigma`` the larger of ``sigma_c`` and the
    residual's own estimate.

    Args:
        camera: the lens.
        object_points: corners in the board frame, ``(n, 3)`` with ``z = 0`` [m].
        image_points: where they were seen, ``(n, 2)`` [px].
        prior: rotation ``(3, 3)`` of the board that is to be expected.

    Returns:
        The pose, or None where too few corners agree.
    """
    X, u = np.asarray(object_points, dtype=np.float64), np.asarray(image_points, dtype=np.float64)
    while len(X) >= _MIN_CORNERS:
        candidates = _both_poses(camera, X, u)
        if not candidates:
            return None
        best = candidates[0]
        residual = np.linalg.norm(best[2], axis=1)
        worst = int(residual.argmax())
        limit = min(_MAX_RESIDUAL, 4 * max(_CORNER_STD, float(np.median(residual))))
        if residual[worst] <= limit:
            return _choose(camera, X, candidates, prior)
        keep = np.arange(len(X)) != worst
        X, u = X[keep], u[keep]
    return None


def _both_poses(camera: PinholeCamera, X: Array, u: Array) -> list[tuple[Array, Array, Array]]:
    """(rotation, position, residuals), the better fit first."""
    cv2 = require("cv2")
    K, distortion = camera.matrix, camera.distortion_array
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(X, u[:, None], K, distortion, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # collinear points
        return []
    found = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(X, u[:, None], K, distortion, rvec, tvec)
        rotation, position = cv2.Rodrigues(rvec)[0], tvec.ravel()
        seen = X @ rotation.T + position
        # the printed side must face the camera, and be before it
        if np.all(np.isfinite(seen)) and np.all(seen[:, 2] > 0) and rotation[:, 2] @ position < 0:
            found.append((rotation, position, u - camera.project(seen)))
    return sorted(found, key=lambda c: float(np.sum(c[2] ** 2)))


def _choose(
    camera: PinholeCamera, X: Array, candidates: list[tuple[Array, Array, Array]], prior: Array | None
) -> BoardPose:
    chosen, ambiguous, mirror = candidates[0], False, None
    if len(candidates) > 1:
        other = candidates[1]
        worse = (np.sum(other[2] ** 2) - np.sum(chosen[2] ** 2)) / _CORNER_STD**2
        if worse < 100 and angle_between(chosen[0], other[0]) > np.radians(2):
            mirror = other[:2]
        ambiguous = bool(worse < 9 and angle_between(chosen[0], other[0]) > np.radians(10))
        if ambiguous and prior is not None:
            nearer = angle_between(other[0], prior) < angle_between(chosen[0], prior)
            chosen, mirror = (other, chosen[:2]) if nearer else (chosen, mirror)
    rotation, position, residual = chosen
    J = projection_jacobian(camera, X, rotation, position)
    freedom = max(2 * len(X) - 6, 1)
    variance = max(_CORNER_STD**2, float(np.sum(residual**2)) / freedom)
    covariance = np.asarray(variance * np.linalg.inv(J.T @ J), dtype=np.float64)
    return BoardPose(rotation, position, covariance, ambiguous, mirror)


def projection_jacobian(camera: PinholeCamera, X: Array, rotation: Array, position: Array) -> Array:
    """``du = (dpi/dx) (dt - [R X]x dphi)`` for ``R+ = exp([dphi]x) R``: ``(2 n, 6)``, columns (v; w)."""
    cv2 = require("cv2")
    rvec = cv2.Rodrigues(rotation)[0]
    _, full = cv2.projectPoints(X, rvec, position, camera.matrix, camera.distortion_array)
    by_position = full[:, 3:6].reshape(-1, 2, 3)  # dpi/dx, since x = R X + t
    by_rotation = -by_position @ hat(torch.from_numpy(X @ rotation.T)).numpy()
    return np.concatenate([by_position, by_rotation], axis=-1).reshape(-1, 6)


def angle_between(a: Array, b: Array) -> float:
    """Angle of the rotation ``a b^T`` between two orientations [rad]."""
    return float(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1)))
