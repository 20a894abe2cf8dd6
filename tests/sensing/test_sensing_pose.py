"""Pose of one board: from its corners, corrected by its edges, robust, and one of two mirror images."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lens import render

from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, PinholeCamera
from torch_ekm.sensing.vision import board_pose
from torch_ekm.sensing.vision.board_pose import estimate_board_pose, projection_jacobian
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging import simulated_camera
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard

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
    monkeypatch.setattr(board_pose, "_MIN_CORNERS", 4)
    monkeypatch.setattr(board_pose, "_CORNER_STD", 0.5)
    camera, board = PinholeCamera(), MarkerBoard(columns=1, rows=1, marker_size=0.012)
    pose, mirrored = pose_of(z=0.6, tilt_deg=25), pose_of(z=0.6, tilt_deg=-25)[:3, :3]
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, pose),)), rng)
    seen = image, camera, board, corners(board, pose, camera)
    assert estimate_board_pose(*seen).ambiguous
    for prior in (pose[:3, :3], mirrored):
        found = estimate_board_pose(*seen, prior)
        assert board_pose.angle_between(found.rotation, prior) < np.radians(15)
    near = pose_of(z=0.2, tilt_deg=25)
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, near),)), rng)
    clear = estimate_board_pose(image, camera, board, corners(board, near, camera), mirrored)
    assert not clear.ambiguous
    assert board_pose.angle_between(clear.rotation, near[:3, :3]) < np.radians(3)


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
    finger = ConvexBody(np.array([[-0.03, 0.012, 0.33], [0.04, 0.02, 0.33]]), np.full(2, 0.007), shade)
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, pose),), (finger,)), rng)
    found = estimate_board_pose(image, camera, board, corners(board, pose, camera))
    error = twist(found.rotation, found.position, pose)
    assert np.abs(error[3:]).max() < np.radians(0.4)
    assert np.abs(error[:2]).max() < 5e-5
