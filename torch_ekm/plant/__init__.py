"""The contract between a hand and whoever drives it; recordings and replays of it."""

from __future__ import annotations

from .gate import Gate
from .observation import Observation, PlantStatus, Stamps, Truth
from .plant import FollowingPlant, FramesAtRest, Path, Plant, PlantWrapper, can_follow
from .recorded import RecordingPlant, ReplayedPlant
from .servo_inverse import ServoInverse
from .trajectory import Movement, Trajectory
from .trial_log import TrialLog, verify_log

__all__ = [
    "FollowingPlant",
    "FramesAtRest",
    "Gate",
    "Movement",
    "Observation",
    "Path",
    "Plant",
    "PlantStatus",
    "PlantWrapper",
    "RecordingPlant",
    "ReplayedPlant",
    "ServoInverse",
    "Stamps",
    "Trajectory",
    "TrialLog",
    "Truth",
    "can_follow",
    "verify_log",
]
