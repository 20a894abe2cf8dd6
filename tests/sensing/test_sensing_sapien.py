"""SAPIEN's renderer against ours. Skipped where there is no Vulkan device."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sapien_camera import SapienCamera

from torch_ekm.description import Shape
from torch_ekm.kinematics.se3 import log
from torch_ekm.sensing import MarkerBoard, MarkerTracker, PinholeCamera
from torch_ekm.simulation import ImageQuality, SimulatedCamera
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard

cv2 = pytest.importorskip("cv2")
pytest.importorskip("sapien")


def test_two_renderers_agree(pose_of, rng):
    if not SapienCamera.available():
        pytest.skip("no Vulkan device")
    boards = MarkerBoard(0), MarkerBoard(4)
    poses = pose_of(-0.05, tilt_deg=35), pose_of(0.05, 0.01, tilt_deg=30)
    finger = ConvexBody.capsule(np.array([0.02, 0.03, 0.33]), np.array([0.10, 0.03, 0.36]), 0.007)
    box = ConvexBody.of_shape(Shape("box", (0.03, 0.04, 0.05), pose_of(0, -0.06, 0.4)))
    cards = tuple(PlacedCard(board, pose) for board, pose in zip(boards, poses, strict=True))
    scene, quality = CardScene(cards, (finger, box)), ImageQuality(vignette=0.0)
    ours, theirs = (kind(quality=quality).render(scene, rng) for kind in (SimulatedCamera, SapienCamera))
    smooth = cv2.GaussianBlur(ours.astype(np.float32) - theirs.astype(np.float32), (0, 0), 2)
    assert np.abs(smooth).mean() < 1.5  # the same things at the same places; light differs a little
    assert np.percentile(np.abs(smooth), 99.9) < 25
    track = MarkerTracker(PinholeCamera(), *boards).track(theirs)
    expected = np.linalg.inv(poses[0]) @ poses[1]
    assert track.ok
    assert np.abs(track.position.numpy() - expected[:3, 3]).max() < 1e-3
    assert log(track.rotation @ torch.from_numpy(expected[:3, :3].T.copy())).norm() < np.radians(0.5)
