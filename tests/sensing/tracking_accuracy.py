"""How well does the tracker see? Two marker boards are drawn in random poses and found again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, MarkerTracker, PinholeCamera
from torch_ekm.simulation import SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, PlacedCard

Array = NDArray[np.float64]

_FLIP = np.radians(10.0)


@dataclass(frozen=True)
class TrackingAccuracy:
    """Errors of poses of boards in the camera frame, and of the object in the hand frame.

    rms values over the frames in which there is a pose. In-plane: about the board's normal;
    lateral: one coordinate across the line of sight; depth: along it.
    """

    frames: int
    found: float
    """Share of frames with a pose."""
    flips: int
    """Boards more than 10 deg off."""
    in_plane_deg: float
    out_of_plane_deg: float
    lateral_mm: float
    depth_mm: float
    depth_bias_mm: float
    object_rotation_deg: float
    """Object in the hand: rms of the whole angle."""
    object_position_mm: float
    """Object in the hand: rms of one coordinate."""
    mean_chi2: float
    """Mean of ``e^T Sigma^-1 e`` of the object's pose; 6 where the covariance is right."""


def measure_tracking(
    n_frames: int,
    seed: int = 0,
    camera: SimulatedCamera | None = None,
    known_camera: PinholeCamera | None = None,
) -> TrackingAccuracy:
    """Track two boards at 0.35 to 0.45 m, each tilted up to 50 deg, in any direction and spin.

    Each frame is a new scene (generator ``seed + k``), and the tracker is reset before it: nothing
    but the image distinguishes one pose from its mirror image.

    Args:
        n_frames: scenes.
        seed: of the first one.
        camera: takes the pictures.
        known_camera: what the tracker takes the lens for; by default the truth.
    """
    camera = camera or SimulatedCamera()
    boards = MarkerBoard(0), MarkerBoard(4)
    tracker = MarkerTracker(known_camera or camera.camera, *boards)
    # columns: twist in the camera frame (6), about the normal, along and across the line of sight
    board_errors, twists, chi2 = [], [], []
    for k in range(n_frames):
        rng = np.random.default_rng(seed + k)
        poses = [random_pose(rng, side * 0.048, 50.0) for side in (-1, 1)]
        scene = CardScene(tuple(PlacedCard(*pair) for pair in zip(boards, poses, strict=True)))
        image = camera.render(scene, rng)
        tracker.reset()
        track = tracker.track(image)
        if track.palm is None or track.object is None or track.position is None:
            continue
        for pose, board in zip(poses, (track.palm, track.object), strict=True):
            board_errors.append(_board_error(pose, board.rotation, board.position))
        relative = np.linalg.inv(poses[0]) @ poses[1]
        assert track.rotation is not None
        assert track.covariance is not None
        turn = log(track.rotation @ torch.from_numpy(relative[:3, :3].T.copy()))
        twist = torch.cat([track.position - torch.from_numpy(relative[:3, 3].copy()), turn])
        twists.append(twist.numpy())
        chi2.append(float(twist @ torch.linalg.solve(track.covariance, twist)))
    e, t = np.array(board_errors), np.array(twists)

    def rms(x: Array) -> float:
        return float(np.sqrt(np.mean(x**2)))

    return TrackingAccuracy(
        frames=n_frames,
        found=len(t) / n_frames,
        flips=int(np.sum(np.hypot(e[:, 0], e[:, 1]) > _FLIP)),
        in_plane_deg=float(np.degrees(rms(e[:, 0]))),
        out_of_plane_deg=float(np.degrees(rms(e[:, 1]))),
        lateral_mm=1e3 * rms(e[:, 2:4]),
        depth_mm=1e3 * rms(e[:, 4]),
        depth_bias_mm=1e3 * float(e[:, 4].mean()),
        object_rotation_deg=float(np.degrees(np.sqrt(3) * rms(t[:, 3:]))),
        object_position_mm=1e3 * rms(t[:, :3]),
        mean_chi2=float(np.mean(chi2)),
    )


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
