"""The contract between a hand and whoever drives it; recordings and replays of it."""

from __future__ import annotations

from .gate import Gate, ServoInverse
from .plant import (
    FollowingPlant,
    FramesAtRest,
    Observation,
    Path,
    Plant,
    PlantStatus,
    PlantWrapper,
    Stamps,
    Truth,
    can_follow,
)
from .trajectory import Movement, RecordingPlant, ReplayedPlant, Trajectory
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
