import cv2
import numpy as np
import pytest
import torch

from torch_ekm.kinematics.se3 import exp
from torch_ekm.simulation import SimulatedCamera

cv2.setNumThreads(1)


def facing(x=0.0, y=0.0, z=0.40, tilt_deg=30.0, azimuth_deg=40.0, spin_deg=20.0):
    """Pose of a card before the camera: z towards it, then tilted about an axis in the image plane."""
    azimuth, tilt, spin = np.radians([azimuth_deg, tilt_deg, spin_deg])
    turns = torch.tensor([[tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0], [0, 0, spin]])
    tilted, spun = exp(turns).numpy()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = tilted @ np.diag([1.0, -1.0, -1.0]) @ spun, [x, y, z]
    return pose


@pytest.fixture(scope="session")
def pose_of():
    return facing


@pytest.fixture(scope="session")
def simulated():
    return SimulatedCamera()


@pytest.fixture
def rng():
    return np.random.default_rng(0)
