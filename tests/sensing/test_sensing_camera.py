"""The lens: projection, its inverse, its calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lens import rays, render

from torch_ekm.exceptions import CalibrationError, ParameterError
from torch_ekm.sensing import MarkerBoard, PinholeCamera, calibrate_camera
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, PlacedCard

cv2 = pytest.importorskip("cv2")

LENS = PinholeCamera(fx=612.0, fy=607.0, cx=331.0, cy=233.0, distortion=(-0.12, 0.08, 1e-3, -7e-4, 0.0))


def test_projection_is_opencvs(rng):
    points = rng.uniform([-0.15, -0.1, 0.3], [0.15, 0.1, 0.5], (50, 3))
    lens = replace(LENS, distortion=(*LENS.distortion[:4], 0.05))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion_array)
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-9)


def test_impossible_lenses_are_refused():
    with pytest.raises(ParameterError, match="fx"):
        PinholeCamera(fx=0.0)
    with pytest.raises(ParameterError, match="distortion"):
        PinholeCamera(distortion=(0.1, 0.0))


SQUARE = 0.025  # [m]
BOARD = cv2.aruco.CharucoBoard(
    (8, 6), SQUARE, 0.018, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
)


class Target:
    """``BOARD``, printed with a white rim of half a square."""

    size = (9 * SQUARE, 7 * SQUARE)

    def texture(self):
        rim = round(SQUARE / 2 / 2.5e-4)
        return BOARD.generateImage((9 * 2 * rim, 7 * 2 * rim), marginSize=rim, borderBits=1)


@pytest.fixture(scope="module")
def target_views(pose_of):
    target, rng = Target(), np.random.default_rng(1)
    views = []
    for _ in range(12):
        pose = pose_of(
            *rng.uniform([-0.06, -0.05, 0.30], [0.06, 0.05, 0.40]),
            tilt_deg=rng.uniform(5, 45),
            azimuth_deg=rng.uniform(0, 360),
            spin_deg=rng.uniform(-30, 30),
        )
        views.append(render(LENS, CardScene((PlacedCard(target, pose),)), rng))
    return views


def test_calibration_recovers_the_lens(target_views):
    blank = np.full_like(target_views[0], 128)
    result = calibrate_camera([*target_views, None, blank], BOARD)
    assert result.used == tuple(range(12))  # the blank one is left out
    assert result.rms < 0.12  # px
    found = result.camera
    for name, tolerance in (("fx", 2.5), ("fy", 2.5), ("cx", 2.0), ("cy", 2.0)):
        error = abs(getattr(found, name) - getattr(LENS, name))
        assert error < tolerance  # px
        assert error < 5 * result.std[name]  # corners of one view share errors: std is a little small
    # what counts: where points appear, over the whole image
    grid = np.stack(np.meshgrid(np.linspace(20, 620, 7), np.linspace(20, 460, 7)), axis=-1)
    seen = np.concatenate([rays(LENS, grid), np.ones((7, 7, 1))], axis=-1)
    assert np.abs(found.project(seen) - grid)[1:-1, 1:-1].max() < 2.5  # px


def test_calibration_says_what_is_missing(target_views):
    with pytest.raises(CalibrationError, match="at least 8"):
        calibrate_camera(target_views[:5], BOARD)
    with pytest.raises(CalibrationError, match="those before"):
        calibrate_camera([target_views[0], target_views[1][:400]], BOARD)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("height", [0.0, 0.0005])
def test_a_card_seen_edge_on_is_drawn_without_complaint(height):
    """Its plane holds the camera's centre, or runs along some of the rays nearby."""
    camera = SimulatedCamera(replace(PinholeCamera(), cy=240.125))  # a row of samples has rays with y = 0
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = [0.0, height, 0.3]
    scene = CardScene((PlacedCard(MarkerBoard(), pose),))
    image, empty = (camera.render(s, np.random.default_rng(0)) for s in (scene, CardScene(())))
    assert (image != empty).any() == (height > 0)
