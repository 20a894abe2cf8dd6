from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._checks import check_positive
from ..._extras import require
from ...exceptions import ParameterError
from ...typing import Array


@dataclass(frozen=True)
class PinholeCamera:
    """``u = fx x'' + cx, v = fy y'' + cy`` with ``x'', y''`` the distorted ``x/z, y/z``.

    Camera frame: x right, y down, z forward [m]. Image: u right, v down [px], the *centre* of
    the first pixel at (0, 0), as in OpenCV. Distortion ``(k1, k2, p1, p2, k3)`` (Brown-Conrady).
    The defaults are those of a VGA camera of 56 deg horizontal field of view.

    Raises:
        ParameterError: a size or focal length is not positive, or the distortion has no 5 entries.
    """

    width: int = 640
    height: int = 480
    fx: float = 600.0
    fy: float = 600.0
    cx: float = 319.5
    cy: float = 239.5
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            check_positive(f"PinholeCamera.{name}", getattr(self, name))
        if len(self.distortion) != 5:
            raise ParameterError("PinholeCamera.distortion", self.distortion, "(k1, k2, p1, p2, k3)")

    @property
    def matrix(self) -> Array:
        """``K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    @property
    def distortion_array(self) -> Array:
        return np.asarray(self.distortion, dtype=np.float64)

    def project(self, points: Array) -> Array:
        """Pixels ``(*batch, 2)`` of points ``(*batch, 3)`` in the camera frame [m], ``z > 0``."""
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        lens = self.matrix, self.distortion_array
        pixels, _ = require("cv2").projectPoints(flat, np.zeros(3), np.zeros(3), *lens)
        return pixels.reshape(*np.shape(points)[:-1], 2)
