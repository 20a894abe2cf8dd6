"""Pose of one board: exact where it should be, robust, with the right covariance."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lens import render

from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, PinholeCamera
from torch_ekm.sensing.vision import board_pose
from torch_ekm.sensing.vision.board_pose import BoardPose, estimate_board_pose, projection_jacobian
from torch_ekm.sensing.vision.edge_refinement import refine_on_edges
from torch_ekm.simulation import ImageQuality, SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard

LENSES = [PinholeCamera(), PinholeCamera(fx=580, cx=300, distortion=(-0.15, 0.1, 1e-3, -5e-4, 0.0))]


def corners(board, pose, camera):
    X = board.corners.reshape(-1, 3)
    return X, camera.project(X @ pose[:3, :3].T + pose[:3, 3])


def twist(estimate, pose):
    turn = log(torch.from_numpy(estimate.rotation @ pose[:3, :3].T)).numpy()
    return np.concatenate([estimate.position - pose[:3, 3], turn])


@pytest.mark.parametrize("camera", LENSES)
@pytest.mark.parametrize("tilt", [0.0, 20.0, 50.0])
def test_exact_corners_give_the_exact_pose(pose_of, camera, tilt):
    pose = pose_of(0.04, -0.05, 0.42, tilt_deg=tilt)
    found = estimate_board_pose(camera, *corners(MarkerBoard(), pose, camera))
    assert np.abs(twist(found, pose)).max() < 1e-6


@pytest.mark.parametrize("camera", LENSES)
def test_jacobian_is_the_derivative_of_the_projection(pose_of, camera):
    pose, X = pose_of(0.05, 0.03), MarkerBoard().corners.reshape(-1, 3)
    R, t, h = pose[:3, :3], pose[:3, 3], 1e-6

    def pixels(step):
        turned = exp(torch.from_numpy(step[3:])).numpy() @ R
        return camera.project(X @ turned.T + t + step[:3]).ravel()

    columns = [(pixels(h * e) - pixels(-h * e)) / (2 * h) for e in np.eye(6)]
    J = projection_jacobian(camera, X, R, t)
    np.testing.assert_allclose(J, np.stack(columns, axis=-1), atol=1e-4 * np.abs(J).max())


def test_covariance_is_that_of_the_errors(pose_of, rng, monkeypatch):
    monkeypatch.setattr(board_pose, "_CORNER_STD", 0.15)
    camera, board, pose = PinholeCamera(), MarkerBoard(), pose_of(tilt_deg=35)
    X, u = corners(board, pose, camera)
    errors, chi2 = [], []
    for _ in range(300):
        found = estimate_board_pose(camera, X, u + 0.15 * rng.standard_normal(u.shape))
        errors.append(twist(found, pose))
        chi2.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]))
    assert np.mean(chi2) == pytest.approx(6.0, rel=0.2)
    stated = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(np.std(errors, axis=0), stated, rtol=0.35)


def test_wrong_corners_are_left_out(pose_of, rng):
    camera, board, pose = PinholeCamera(), MarkerBoard(), pose_of()
    X, u = corners(board, pose, camera)
    u = u + 0.05 * rng.standard_normal(u.shape)
    spoilt = u.copy()
    spoilt[3] += [4.0, -3.0]
    spoilt[9] += [-2.5, 2.0]
    found = estimate_board_pose(camera, X, spoilt)
    without = np.delete(np.arange(16), [3, 9])
    same = estimate_board_pose(camera, X[without], u[without])
    np.testing.assert_allclose(found.position, same.position, atol=1e-9)


def test_nothing_comes_of_nonsense(rng):
    X = MarkerBoard().corners.reshape(-1, 3)
    assert estimate_board_pose(PinholeCamera(), X, rng.uniform(0, 400, (16, 2))) is None
    assert estimate_board_pose(PinholeCamera(), X[:5], rng.uniform(0, 400, (5, 2))) is None
    line = X[[0, 1, 4, 5, 0, 1]]  # one row of corners: no plane
    u = 320 + 1500 * line[:, :2]
    assert estimate_board_pose(PinholeCamera(), line, u) is None


def test_prior_decides_between_mirror_images(pose_of, monkeypatch):
    """A small board far away: both solutions fit, the one near the prior is taken."""
    monkeypatch.setattr(board_pose, "_MIN_CORNERS", 4)
    monkeypatch.setattr(board_pose, "_CORNER_STD", 0.5)
    camera, board = PinholeCamera(), MarkerBoard(columns=1, rows=1, marker_size=0.012)
    pose = pose_of(z=0.6, tilt_deg=25)
    X, u = corners(board, pose, camera)
    free = estimate_board_pose(camera, X, u)
    assert free.ambiguous
    assert np.abs(twist(free, pose)).max() < 1e-4  # exact corners: the better one is the true one
    mirrored = pose_of(z=0.6, tilt_deg=-25)[:3, :3]
    other = estimate_board_pose(camera, X, u, prior=mirrored)
    towards = log(torch.from_numpy(other.rotation @ mirrored.T)).norm()
    assert float(towards) < np.radians(12)
    monkeypatch.setattr(board_pose, "_CORNER_STD", 1e-3)
    clear = estimate_board_pose(camera, X, u, prior=mirrored)
    assert not clear.ambiguous
    assert np.abs(twist(clear, pose)).max() < 1e-4


@pytest.mark.parametrize("camera", LENSES)
def test_edges_correct_a_rough_pose(pose_of, camera, rng):
    board, pose = MarkerBoard(), pose_of(0.03, 0.02, tilt_deg=30)
    quality = ImageQuality(noise=1.0, vignette=0.0)
    image = render(camera, CardScene((PlacedCard(board, pose),)), rng, quality)
    rough = exp(torch.tensor([0.01, -0.008, 0.005], dtype=torch.float64)).numpy() @ pose[:3, :3]
    start = BoardPose(rough, pose[:3, 3] + [1e-4, -1e-4, 1e-3], np.eye(6), False)
    error = twist(refine_on_edges(image, camera, board, start), pose)
    assert np.abs(error[:2]).max() < 2e-5  # m
    assert abs(error[2]) < 3e-4
    assert np.abs(error[3:]).max() < np.radians(0.15)


@pytest.mark.parametrize("shade", [40, 90, 215])
def test_edges_of_a_half_hidden_board_still_count(pose_of, rng, shade):
    camera, board, pose = PinholeCamera(), MarkerBoard(), pose_of(tilt_deg=30)
    finger = ConvexBody.capsule(np.array([-0.03, 0.012, 0.33]), np.array([0.04, 0.02, 0.33]), 0.007, shade)
    image = SimulatedCamera(camera).render(CardScene((PlacedCard(board, pose),), (finger,)), rng)
    start = BoardPose(pose[:3, :3], pose[:3, 3], np.eye(6), False)
    refined = refine_on_edges(image, camera, board, start)
    assert refined is not start
    error = twist(refined, pose)
    assert np.abs(error[3:]).max() < np.radians(0.4)
    assert np.abs(error[:2]).max() < 5e-5


def test_no_edges_leave_the_pose_alone(pose_of):
    blank = np.full((480, 640), 128, dtype=np.uint8)
    start = BoardPose(pose_of()[:3, :3], pose_of()[:3, 3], np.eye(6), False)
    assert refine_on_edges(blank, PinholeCamera(), MarkerBoard(), start) is start
