"""Drawn images, through lenses that distort, too; the pose of one board in them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, PinholeCamera, tracker
from torch_ekm.sensing.tracker import estimate_board_pose, projection_jacobian
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging import simulated_camera
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard


@pytest.fixture
def clean(monkeypatch):
    for name in ("_NOISE", "_BLUR", "_VIGNETTE"):
        monkeypatch.setattr(simulated_camera, name, 0.0)


def rays(lens: PinholeCamera, pixels: np.ndarray) -> np.ndarray:
    """Inverse of ``lens.project``: ``(x/z, y/z)`` of pixels, ``(*batch, 2)``."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float64)
    found = cv2.undistortPoints(flat, lens.matrix, lens.distortion_array, criteria=criteria)
    return found.reshape(pixels.shape)


def render(lens: PinholeCamera, scene, rng) -> np.ndarray:
    """The picture of an ideal lens, each pixel taken from where its ray meets it."""
    ideal = replace(lens, distortion=(0.0,) * 5)
    image = SimulatedCamera(ideal).render(scene, rng)
    if not any(lens.distortion):
        return image
    v, u = np.mgrid[: lens.height, : lens.width]
    at = rays(lens, np.stack([u, v], axis=-1)) * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    return cv2.remap(image, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


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
    for make, options, error, said in (
        (MarkerBoard, {"gap": 0.0}, ParameterError, "gap"),
        (MarkerBoard, {"first_id": 48}, ParameterError, r"0\.\.46"),
        (MarkerBoard, {"mount": np.eye(3)}, ShapeError, r"\(4, 4\)"),
        (PinholeCamera, {"fx": 0.0}, ParameterError, "fx"),
        (PinholeCamera, {"distortion": (0.1, 0.0)}, ParameterError, "distortion"),
    ):
        with pytest.raises(error, match=said):
            make(**options)


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


LENSES = [PinholeCamera(), PinholeCamera(fx=580, cx=300, distortion=(-0.15, 0.1, 1e-3, -5e-4, 0.0))]
BLANK = np.full((480, 640), 128, dtype=np.uint8)


def corners(board, pose, camera):
    """Exact pixels of the corners of each marker."""
    return dict(zip(board.ids, camera.project(board.corners @ pose[:3, :3].T + pose[:3, 3]), strict=True))


def twist(rotation, position, pose):
    turn = log(torch.from_numpy(rotation @ pose[:3, :3].T)).numpy()
    return np.concatenate([position - pose[:3, 3], turn])


@pytest.mark.parametrize("camera", LENSES)
def test_jacobian_is_the_derivative_of_the_projection(pose_of, camera):
    pose, X = pose_of(0.05, 0.03), MarkerBoard().corners.reshape(-1, 3)
    R, t, h = pose[:3, :3], pose[:3, 3], 1e-6

    def pixels(step):
        turned = exp(torch.from_numpy(step[3:])).numpy() @ R
        return camera.project(X @ turned.T + t + step[:3])

    columns = [(pixels(h * e) - pixels(-h * e)) / (2 * h) for e in np.eye(6)]
    J = projection_jacobian(camera, X, R, t)
    np.testing.assert_allclose(J, np.stack(columns, axis=-1), atol=1e-4 * np.abs(J).max())


def test_nothing_comes_of_nonsense(pose_of, rng):
    camera, board = PinholeCamera(), MarkerBoard()
    wild = {k: rng.uniform(0, 400, (4, 2)) for k in board.ids}
    few = {0: wild[0]}
    flat = {k: np.full((4, 2), 240.0) + 30 * np.arange(4)[:, None] + 200 * k for k in range(2)}  # no plane
    unseen = corners(board, pose_of(), camera)  # no edges
    for markers in (wild, few, flat, unseen):
        assert estimate_board_pose(BLANK, camera, board, markers) is None


def test_prior_decides_between_mirror_images(pose_of, rng, monkeypatch):
    """A small board far away: both solutions fit, the one near the prior is taken."""
    monkeypatch.setattr(tracker, "_MIN_CORNERS", 4)
    monkeypatch.setattr(tracker, "_CORNER_STD", 0.5)
    camera, board = PinholeCamera(), MarkerBoard(columns=1, rows=1, marker_size=0.012)
    pose, mirrored = pose_of(z=0.6, tilt_deg=25), pose_of(z=0.6, tilt_deg=-25)[:3, :3]
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, pose),)), rng)
    seen = image, camera, board, corners(board, pose, camera)
    assert estimate_board_pose(*seen).ambiguous
    for prior in (pose[:3, :3], mirrored):
        found = estimate_board_pose(*seen, prior)
        assert tracker.angle_between(found.rotation, prior) < np.radians(15)
    near = pose_of(z=0.2, tilt_deg=25)
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, near),)), rng)
    clear = estimate_board_pose(image, camera, board, corners(board, near, camera), mirrored)
    assert not clear.ambiguous
    assert tracker.angle_between(clear.rotation, near[:3, :3]) < np.radians(3)


@pytest.mark.parametrize("camera", LENSES)
def test_edges_correct_rough_corners(pose_of, camera, rng, monkeypatch):
    monkeypatch.setattr(simulated_camera, "_NOISE", 1.0)
    monkeypatch.setattr(simulated_camera, "_VIGNETTE", 0.0)
    board, pose = MarkerBoard(), pose_of(0.03, 0.02, tilt_deg=30)
    image = render(camera, CardScene((PlacedCard(board, pose),)), rng)
    rough = {k: u + 0.3 * rng.standard_normal((4, 2)) for k, u in corners(board, pose, camera).items()}
    found = estimate_board_pose(image, camera, board, rough)
    error = twist(found.rotation, found.position, pose)
    assert np.abs(error[:2]).max() < 2e-5  # m
    assert abs(error[2]) < 3e-4
    assert np.abs(error[3:]).max() < np.radians(0.15)


@pytest.mark.parametrize("shade", [40, 215])
def test_edges_of_a_half_hidden_board_still_count(pose_of, rng, shade):
    camera, board, pose = PinholeCamera(), MarkerBoard(), pose_of(tilt_deg=30)
    ends = np.array([[-0.03, 0.012, 0.33], [0.04, 0.02, 0.33]])
    finger = ConvexBody(ends, np.full(2, 0.007), shade)
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, pose),), (finger,)), rng)
    found = estimate_board_pose(image, camera, board, corners(board, pose, camera))
    error = twist(found.rotation, found.position, pose)
    assert np.abs(error[3:]).max() < np.radians(0.4)
    assert np.abs(error[:2]).max() < 5e-5
