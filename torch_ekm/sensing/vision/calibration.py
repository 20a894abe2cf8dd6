"""The lens from pictures of a target: intrinsic calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import CalibrationError
from .camera import PinholeCamera

_MIN_VIEWS = 8  # fewer usable pictures are refused
_MIN_CORNERS = 12  # a picture with fewer is not used
_MAX_VIEW_RMS = 1.0  # a picture with more is not used [px]


@dataclass(frozen=True)
class CameraCalibration:
    """A camera, and how well the pictures determine it."""

    camera: PinholeCamera
    rms: float
    """Root mean square distance of corners from where the camera puts them [px]."""
    std: dict[str, float]
    """Standard deviations of fx, fy, cx, cy [px] and k1, k2, p1, p2, k3, were all corners independent.

    They are not quite: with a dozen views, count on twice as much."""
    used: tuple[int, ...]
    """Numbers of the pictures that were used; the others showed too little of the target, or blurred."""


def calibrate_camera(images: Iterable[NDArray[np.uint8] | None], board: Any) -> CameraCalibration:
    """``min sum |u_ij - pi(K, k, R_i X_j + t_i)|^2`` over intrinsics (k3 = 0) and the pose of each view.

    Corners of a ChArUco target (OpenCV's detector), then Zhang's method (``cv2.calibrateCamera``).
    Views whose own error exceeds 1 px are left out and the rest solved again, once.
    The target should fill different parts of the image, at tilts up to about 45 deg: frontal views
    alone do not separate focal length from distance.

    Args:
        images: grey or BGR pictures of one size; None (dropped frames) are skipped.
        board: what is seen, a ``cv2.aruco.CharucoBoard`` with its lengths in [m].

    Raises:
        CalibrationError: too few usable views, or pictures of different sizes.
    """
    cv2 = require("cv2")
    detector = cv2.aruco.CharucoDetector(board)
    points = board.getChessboardCorners()
    views: list[tuple[int, NDArray, NDArray]] = []
    shape = None
    for k, image in enumerate(images):
        if image is None:
            continue
        if shape is not None and image.shape[:2] != shape:
            raise CalibrationError("camera", f"picture {k} is {image.shape[:2]}, those before are {shape}")
        shape = image.shape[:2]
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is not None and len(ids) >= _MIN_CORNERS:
            views.append((k, points[ids.ravel()].reshape(-1, 3), corners.reshape(-1, 2)))
    if shape is None or len(views) < _MIN_VIEWS:
        problem = f"only {len(views)} pictures show {_MIN_CORNERS} or more corners of the target, at least "
        problem += f"{_MIN_VIEWS} are needed; move the target about, closer, in good light"
        raise CalibrationError("camera", problem)

    def solve(chosen: list[tuple[int, NDArray, NDArray]]):
        size = (shape[1], shape[0])
        points, corners = [view[1] for view in chosen], [view[2] for view in chosen]
        return cv2.calibrateCameraExtended(points, corners, size, None, None, flags=cv2.CALIB_FIX_K3)

    rms, K, k, _, _, std, _, errors = solve(views)
    good = [view for view, error in zip(views, errors.ravel(), strict=True) if error <= _MAX_VIEW_RMS]
    if _MIN_VIEWS <= len(good) < len(views):
        views = good
        rms, K, k, _, _, std, _, errors = solve(views)
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = tuple(float(c) for c in k.ravel()[:5])
    camera = PinholeCamera(shape[1], shape[0], fx, fy, cx, cy, lens)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    deviations = {name: float(s) for name, s in zip(names, std.ravel(), strict=False)}
    return CameraCalibration(camera, float(rms), deviations, tuple(view[0] for view in views))
