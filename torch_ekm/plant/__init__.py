"""The contract between a hand and whoever drives it; recordings and replays of it."""

from __future__ import annotations

from .observation import Observation as Observation
from .observation import PlantStatus as PlantStatus
from .observation import Truth as Truth
from .plant import Plant as Plant
from .recording_plant import RecordingPlant as RecordingPlant
from .replayed_plant import ReplayedPlant as ReplayedPlant
from .trajectory import Trajectory as Trajectory
from .trial_log import TrialEntry as TrialEntry
from .trial_log import TrialLog as TrialLog
from .wrapper import PlantWrapper as PlantWrapper

__all__ = [
    "Observation",
    "Plant",
    "PlantStatus",
    "PlantWrapper",
    "RecordingPlant",
    "ReplayedPlant",
    "Trajectory",
    "TrialEntry",
    "TrialLog",
    "Truth",
]
