"""Drawn images: cards where they belong, bodies before them, noise of the stated size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lens import render

from torch_ekm.exceptions import ParameterError, ShapeError, UnknownNameError
from torch_ekm.sensing import MarkerBoard, PinholeCamera
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging import simulated_camera
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard

cv2 = pytest.importorskip("cv2")


@pytest.fixture
def clean(monkeypatch):
    for name in ("_NOISE", "_BLUR", "_VIGNETTE"):
        monkeypatch.setattr(simulated_camera, name, 0.0)


@pytest.mark.parametrize("lens", [(0.0,) * 5, (-0.15, 0.1, 1e-3, -5e-4, 0.0)])
def test_markers_are_found_where_they_were_drawn(pose_of, lens, rng):
    camera = PinholeCamera(distortion=lens)
    board, pose = MarkerBoard(8, columns=3, rows=2), pose_of(0.05, 0.03)
    image = render(camera, CardScene((PlacedCard(board, pose),)), rng)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.relativeCornerRefinmentWinSize = 0.5
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    assert sorted(ids.ravel()) == list(board.ids)
    truth = camera.project(board.corners @ pose[:3, :3].T + pose[:3, 3])
    for found, k in zip(corners, ids.ravel(), strict=True):
        assert np.abs(found[0] - truth[k - 8]).max() < 1.0  # px, corner by corner: order and place
        assert np.abs(found[0].mean(0) - truth[k - 8].mean(0)).max() < 0.2  # no half-pixel shift


def test_card_is_as_bright_as_its_print(pose_of, rng, clean, monkeypatch):
    """Area and mean grey level of a drawn card are those of the geometry (coverage, not just sampling)."""
    board, pose = MarkerBoard(), pose_of(tilt_deg=20)
    for name, level in (("_BLACK", 0.0), ("_WHITE", 255.0), ("_BACKGROUND", 100.0)):
        monkeypatch.setattr(simulated_camera, name, level)
    camera = SimulatedCamera()
    image = camera.render(CardScene((PlacedCard(board, pose),)), rng).astype(float)
    corners = camera.camera.project(PlacedCard(board, pose).outline)
    area = cv2.contourArea(corners.astype(np.float32))
    light = 0.7 + 0.3 * abs(pose[:3, 2] @ pose[:3, 3]) / np.linalg.norm(pose[:3, 3])
    expected = area * (board.texture.mean() * light - 100)  # no seam where card and background mix
    assert (image - 100).sum() == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize(("depth", "hidden"), [(0.30, True), (0.45, False)])
def test_a_ball_hides_a_card_only_from_before(pose_of, rng, clean, depth, hidden):
    board, pose = MarkerBoard(), pose_of(tilt_deg=10)
    camera = SimulatedCamera()
    ball = ConvexBody(np.array([[0, 0, depth]]), np.array([0.01]), shade=77)
    free = camera.render(CardScene((PlacedCard(board, pose),)), rng)
    image = camera.render(CardScene((PlacedCard(board, pose),), (ball,)), rng)
    covered = cv2.contourArea(ball.outline(camera.camera).astype(np.float32))
    if hidden:
        assert (image == 77).sum() == pytest.approx(covered, rel=0.05)
        assert (image != free).sum() == pytest.approx(covered, rel=0.25)
    else:
        np.testing.assert_array_equal(image, free)


def test_cards_outside_or_behind_are_not_drawn(pose_of, rng, clean):
    camera = SimulatedCamera()
    empty = camera.render(CardScene(), rng)
    behind = pose_of()
    behind[2, 3] = -0.4
    for pose in (pose_of(x=2.0), pose_of(y=-2.0), behind, pose_of(z=0.005)):
        np.testing.assert_array_equal(
            camera.render(CardScene((PlacedCard(MarkerBoard(), pose),)), rng), empty
        )
    half = pose_of(x=0.4 * 320 / 600)  # cut by the border of the image
    assert (camera.render(CardScene((PlacedCard(MarkerBoard(), half),)), rng) != empty).any()


def test_impossible_boards_and_bodies_are_refused():
    with pytest.raises(ParameterError, match="gap"):
        MarkerBoard(gap=0.0)
    with pytest.raises(ParameterError, match=r"0\.\.46"):
        MarkerBoard(first_id=48)
    with pytest.raises(UnknownNameError, match="DICT_4X4_50"):
        MarkerBoard(dictionary="DICT_9X9")
    with pytest.raises(ShapeError, match=r"\(4, 4\)"):
        MarkerBoard(mount=np.eye(3))
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
