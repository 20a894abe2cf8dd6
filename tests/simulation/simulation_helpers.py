"""Measures that several tests of the plant share."""

import math

import torch

from torch_ekm.kinematics.se3 import log
from torch_ekm.plant import Observation

DEG = math.pi / 180


def motion(earlier: Observation, later: Observation) -> tuple[torch.Tensor, torch.Tensor]:
    """True translation [m] and rotation vector [rad] of the object between two observations."""
    a, b = earlier.truth, later.truth
    return b.position - a.position, log(b.rotation @ a.rotation.mT)


def increment(**moves: float) -> torch.Tensor:
    """Command to the iCub hand [rad] from named moves [deg]."""
    names = (
        "hand_finger", "thumb_oppose", "thumb_proximal", "thumb_distal", "index_proximal",
        "index_distal", "middle_proximal", "middle_distal", "pinky",
    )  # fmt: skip
    delta = torch.zeros(len(names), dtype=torch.float64)
    for name, value in moves.items():
        delta[names.index(name)] = value * DEG
    return delta


SQUEEZE = increment(thumb_distal=3.0, index_distal=2.0, middle_distal=2.0)
ROLL = increment(thumb_distal=-3.0, index_distal=2.0, middle_distal=2.0)


def turned(plant, delta):
    """Rotation about the grasp's axis that a command brings [rad]."""
    before = plant.observe()
    return float(motion(before, plant.command(delta))[1] @ plant.rotation_axis)


def truth(observation, name="q"):
    return getattr(observation.truth, name)
