"""How well the tracker sees: two marker boards are drawn in random poses and found again."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, MarkerTracker
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, PlacedCard

Array = NDArray[np.float64]

_FLIP = np.radians(10.0)


def measure_tracking(n_frames: int, seed: int = 0) -> dict[str, float]:
    """Track two boards at 0.35 to 0.45 m, each tilted up to 50 deg, in any direction and spin.

    Each frame is a new scene (generator ``seed + k``), and the tracker is reset before it: nothing but the
    image distinguishes one pose from its mirror image. Errors are rms: in-plane about the board's normal,
    lateral one coordinate across the line of sight, depth along it; ``chi2`` is the mean of
    ``e^T Sigma^-1 e`` of the object's pose.
    """
    camera, boards = SimulatedCamera(), (MarkerBoard(0), MarkerBoard(4))
    tracker = MarkerTracker(camera.camera, *boards)
    errors, chi2 = [], []
    for k in range(n_frames):
        rng = np.random.default_rng(seed + k)
        poses = [random_pose(rng, side * 0.048, 50.0) for side in (-1, 1)]
        scene = CardScene(tuple(PlacedCard(*pair) for pair in zip(boards, poses, strict=True)))
        tracker.reset()
        track = tracker.track(camera.render(scene, rng))
        if track.palm is None or track.object is None or track.position is None:
            continue
        for pose, board in zip(poses, (track.palm, track.object), strict=True):
            errors.append(_board_error(pose, board.rotation, board.position))
        relative = np.linalg.inv(poses[0]) @ poses[1]
        assert track.rotation is not None
        assert track.covariance is not None
        turn = log(track.rotation @ torch.from_numpy(relative[:3, :3].T.copy()))
        twist = torch.cat([track.position - torch.from_numpy(relative[:3, 3].copy()), turn])
        chi2.append(float(twist @ torch.linalg.solve(track.covariance, twist)))
    e = np.array(errors)
    rms = np.sqrt(np.mean(e**2, axis=0))
    return {
        "found": len(chi2) / n_frames,
        "flips": int(np.sum(np.hypot(e[:, 0], e[:, 1]) > _FLIP)),
        "in_plane_deg": float(np.degrees(rms[0])),
        "out_of_plane_deg": float(np.degrees(rms[1])),
        "lateral_mm": 1e3 * float(np.sqrt(np.mean(rms[2:4] ** 2))),
        "depth_bias_mm": 1e3 * float(e[:, 4].mean()),
        "chi2": float(np.mean(chi2)),
    }


def random_pose(rng: np.random.Generator, x: float, max_tilt_deg: float) -> Array:
    """A board near ``x`` [m] whose normal is up to ``max_tilt_deg`` off the line of sight."""
    position = np.array([x + rng.uniform(-0.015, 0.015), rng.uniform(-0.05, 0.05), 0.0])
    position[2] = np.sqrt(rng.uniform(0.35, 0.45) ** 2 - position @ position)
    sight = position / np.linalg.norm(position)
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    facing = np.column_stack([right, np.cross(-sight, right), -sight])
    azimuth, spin = rng.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(rng.uniform(0, max_tilt_deg))
    turns = torch.tensor([[tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0], [0, 0, spin]])
    tilted, spun = exp(turns.double()).numpy()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = facing @ tilted @ spun, position
    return pose


def _board_error(truth: Array, rotation: Array, position: Array) -> Array:
    """In-plane, out-of-plane [rad], two lateral, depth [m]."""
    turn = log(torch.from_numpy(rotation @ truth[:3, :3].T)).numpy()
    normal, sight = truth[:3, 2], truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    offset = position - truth[:3, 3]
    depth = offset @ sight
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    in_plane = turn @ normal
    out_of_plane = np.sqrt(max(turn @ turn - in_plane**2, 0.0))
    return np.array([in_plane, out_of_plane, offset @ right, offset @ np.cross(sight, right), depth])
