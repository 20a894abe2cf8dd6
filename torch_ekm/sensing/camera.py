"""A camera as it was calibrated, and the boards of markers that it looks at."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .._checks import check_positive
from .._extras import require
from ..exceptions import ParameterError, ShapeError
from ..typing import Array


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


_TEXEL = 2.5e-4  # [m]


def dictionary():
    """OpenCV's 50 markers of 4 x 4 bits."""
    aruco = require("cv2").aruco
    return aruco.getPredefinedDictionary(aruco.DICT_4X4_50)


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """``rows x columns`` ArUco markers (4 x 4 bits) of edge ``marker_size`` [m], ``gap`` apart, on white.

    Board frame: origin at the centre of the card, x to the right, y up, **z out of the printed
    face**. Several coplanar markers determine the pose far better than one does: a single small
    square has two nearly equal solutions, and noise flips between them (Collins and Bartoli, IJCV 2014).

    Raises:
        ParameterError: a size that is not positive, or more markers than OpenCV's 50.
        ShapeError: ``mount`` is not ``(4, 4)``.
    """

    first_id: int = 0
    """The markers are numbered ``first_id, first_id + 1, ...``, row by row from the upper left."""
    columns: int = 2
    rows: int = 2
    marker_size: float = 0.020
    gap: float = 0.004
    margin: float = 0.004
    """Width of the white rim around the outer markers [m]."""
    mount: Array = field(default_factory=lambda: np.eye(4), repr=False)
    """Pose of the board frame in the frame of the body that carries it, ``(4, 4)``."""

    def __post_init__(self) -> None:
        for name in ("columns", "rows", "marker_size", "gap", "margin"):
            check_positive(f"MarkerBoard.{name}", getattr(self, name))
        object.__setattr__(self, "mount", np.array(self.mount, dtype=np.float64))
        if self.mount.shape != (4, 4):
            raise ShapeError("MarkerBoard.mount", "(4, 4)", self.mount.shape)
        available = len(dictionary().bytesList)
        if self.first_id < 0 or self.first_id + self.n_markers > available:
            valid = f"within 0..{available - self.n_markers}"
            raise ParameterError("MarkerBoard.first_id", self.first_id, valid)

    @property
    def n_markers(self) -> int:
        return self.rows * self.columns

    @property
    def ids(self) -> range:
        return range(self.first_id, self.first_id + self.n_markers)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the card [m]."""
        pitch = self.marker_size + self.gap
        extra = 2 * self.margin - self.gap
        return self.columns * pitch + extra, self.rows * pitch + extra

    @cached_property
    def corners(self) -> Array:
        """Corners of each marker in the board frame, ``(n_markers, 4, 3)`` [m].

        In the order in which the detector reports them: upper left, upper right, lower right, lower left.
        """
        pitch, s = self.marker_size + self.gap, self.marker_size
        width, height = self.size
        square = np.array([[0, 0], [s, 0], [s, -s], [0, -s]])
        row, column = np.divmod(np.arange(self.n_markers), self.columns)
        left, upper = -width / 2 + self.margin + column * pitch, height / 2 - self.margin - row * pitch
        corners = np.zeros((self.n_markers, 4, 3))
        corners[:, :, :2] = np.stack([left, upper], axis=-1)[:, None] + square
        return corners

    @cached_property
    def texture(self) -> NDArray[np.uint8]:
        """The printed card: 0 black, 255 white, texels of about 0.25 mm, upper left first.

        Marker edges need not fall between texels: each marker is drawn with linear interpolation, which
        puts the middle of the transition at the edge.
        """
        cv2 = require("cv2")
        width, height = self.size
        n_x, n_y = round(width / _TEXEL), round(height / _TEXEL)
        scale = np.array([n_x / width, n_y / height])  # texels per metre
        cells = dictionary().markerSize + 2
        side = cells * max(1, round(self.marker_size / _TEXEL / cells))
        card = np.full((n_y, n_x), 255, dtype=np.uint8)
        for k, marker_id in enumerate(self.ids):
            upper_left = (self.corners[k, 0, :2] * [1, -1] + [width / 2, height / 2]) * scale
            ratio = self.marker_size * scale / side
            shift = upper_left + ratio / 2 - 0.5  # continuous coordinates: texel i has its centre at i + 0.5
            affine = np.array([[ratio[0], 0, shift[0]], [0, ratio[1], shift[1]]])
            marker = cv2.aruco.generateImageMarker(dictionary(), marker_id, side)
            drawn = cv2.warpAffine(marker, affine, (n_x, n_y), borderValue=255)
            np.minimum(card, drawn, out=card)
        return card
