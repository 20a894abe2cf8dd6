"""A lens as a VGA camera has it, and its calibration by OpenCV from pictures of a ChArUco board."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from simulated_hand.tracking_accuracy import random_pose

from torch_ekm._extras import require
from torch_ekm.sensing import PinholeCamera
from torch_ekm.simulation import ImageQuality, SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, PlacedCard

#: What is taken for the lens that nobody has calibrated: its resolution and field of view.
DATASHEET = PinholeCamera()
VIEWS = 20  # of the ChArUco board
_FINE = 2  # samples of each pixel, per direction
_MARGIN = 1.3  # of the undistorted picture beyond the field of view
_LEAST_CORNERS = 8  # of a view that is used


def lens_of(seed: int) -> PinholeCamera:
    """One lens, drawn: focal length within 5 % of the data sheet's, axis within 10 px of the middle, ``k1``
    from -0.35 to 0.1, ``k2 = -k1 / 2``, as calibrations of VGA cameras that others publish have them."""
    draw = np.random.default_rng([seed, 41])
    focal = DATASHEET.fx * draw.uniform(0.95, 1.05)
    k1, (p1, p2) = draw.uniform(-0.35, 0.1), draw.uniform(-1e-3, 1e-3, 2).tolist()
    return dataclasses.replace(
        DATASHEET,
        fx=focal,
        fy=focal * draw.uniform(0.997, 1.003),
        cx=DATASHEET.cx + draw.uniform(-10, 10),
        cy=DATASHEET.cy + draw.uniform(-10, 10),
        distortion=(k1, -k1 / 2, p1, p2, 0.0),
    )


class DistortingCamera(SimulatedCamera):
    """``I(u) = I_0(K_0 d^-1(K^-1 u))``: a sharp picture without distortion, looked up where each quarter of a
    pixel sees it; then blur and noise.

    Args:
        lens: with its distortion ``d``.
    """

    def __init__(self, lens: PinholeCamera) -> None:
        wide = {name: round(_FINE * _MARGIN * getattr(lens, name)) for name in ("width", "height")}
        ideal = PinholeCamera(
            **wide, fx=_FINE * lens.fx, fy=_FINE * lens.fx, cx=wide["width"] / 2, cy=wide["height"] / 2
        )
        super().__init__(ideal, ImageQuality(blur=0.0, noise=0.0))
        self.lens, self.spoils = lens, ImageQuality()
        v, u = (np.mgrid[: _FINE * lens.height, : _FINE * lens.width] + 0.5) / _FINE - 0.5
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        until = (3, 40, 1e-10)  # iterations and accuracy
        rays = require("cv2").undistortPoints(
            pixels, lens.matrix, lens.distortion_array, None, None, None, until
        )
        rays = rays.reshape(*u.shape, 2)
        self._where = (rays * ideal.fx + [ideal.cx, ideal.cy]).astype(np.float32)

    def render(self, scene: CardScene, generator: np.random.Generator) -> NDArray[np.uint8]:
        """Picture ``(height, width)`` through the lens; the generator draws its noise."""
        cv2 = require("cv2")
        fine = super().render(scene, generator).astype(np.float32)
        seen = cv2.remap(fine, self._where, None, cv2.INTER_LINEAR)
        size = self.lens.width, self.lens.height
        return self.spoils.spoil(cv2.resize(seen, size, interpolation=cv2.INTER_AREA), generator)


class _Print:
    """The ChArUco board on its sheet: 7 x 5 squares of 30 mm."""

    def __init__(self) -> None:
        aruco = require("cv2").aruco
        dictionary = aruco.getPredefinedDictionary(aruco.DICT_5X5_50)
        self.board = aruco.CharucoBoard((7, 5), 0.030, 0.022, dictionary)

    @property
    def size(self) -> tuple[float, float]:
        """Of the sheet, with a rim of half a square [m]."""
        return 0.240, 0.180

    def texture(self) -> NDArray[np.uint8]:
        """Its print, in texels of 0.25 mm."""
        return self.board.generateImage((960, 720), marginSize=60)


class Calibration(NamedTuple):
    """What comes of the pictures."""

    camera: PinholeCamera
    reprojection: float
    """rms of the corners [px]."""
    views: int
    """That showed enough corners."""


@cache
def calibrated(seed: int, views: int = VIEWS) -> Calibration:
    """``cv2.calibrateCamera`` on pictures of a ChArUco board, 0.25 to 0.55 m away and tilted up to 45 deg."""
    cv2, draw = require("cv2"), np.random.default_rng([seed, 42])
    camera, sheet = DistortingCamera(lens_of(seed)), _Print()
    detector = cv2.aruco.CharucoDetector(sheet.board)
    places, pixels = [], []
    for _ in range(views):
        pose = random_pose(draw, draw.uniform(-0.07, 0.07), 45.0)
        pose[:3, 3] *= draw.uniform(0.7, 1.25)
        image = camera.render(CardScene((PlacedCard(sheet, pose),)), draw)
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is not None and len(ids) >= _LEAST_CORNERS:
            place, pixel = sheet.board.matchImagePoints(corners, ids)
            places.append(place)
            pixels.append(pixel)
    size = DATASHEET.width, DATASHEET.height
    rms, matrix, distortion, *_ = cv2.calibrateCamera(places, pixels, size, None, None)
    (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
    found = PinholeCamera(*size, fx, fy, cx, cy, tuple(distortion.ravel()[:5].tolist()))
    return Calibration(found, float(rms), len(places))


#: How the tracker comes to know the lens -> the lens that it takes it for, by seed.
LENSES: dict[str, Callable[[int], PinholeCamera]] = {
    "not calibrated": lambda seed: DATASHEET,
    "5 pictures": lambda seed: calibrated(seed, 5).camera,
    "20 pictures": lambda seed: calibrated(seed).camera,
    "exact": lens_of,
}
