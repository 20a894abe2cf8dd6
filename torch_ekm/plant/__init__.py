"""The contract between a hand and whoever drives it; recordings and replays of it."""

from __future__ import annotations

from .frames_at_rest import FramesAtRest
from .gate import Gate
from .observation import Observation, PlantStatus, Stamps, Truth
from .path import Path
from .plant import FollowingPlant, Plant, can_follow
from .recording_plant import RecordingPlant
from .replayed_plant import ReplayedPlant
from .servo_inverse import ServoInverse
from .trajectory import Movement, Trajectory
from .trial_log import TrialLog
from .verification import verify_log
from .wrapper import PlantWrapper

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
