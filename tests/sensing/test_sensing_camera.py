"""The lens: projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torch_ekm.exceptions import ParameterError
from torch_ekm.sensing import MarkerBoard, PinholeCamera
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
