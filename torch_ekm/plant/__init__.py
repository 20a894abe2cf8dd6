"""The contract between a hand and whoever drives it; recordings and replays of it."""

from __future__ import annotations

from .plant import Observation as Observation
from .plant import Plant as Plant
from .plant import PlantStatus as PlantStatus
from .recording_plant import RecordingPlant as RecordingPlant
from .replayed_plant import ReplayedPlant as ReplayedPlant
from .trajectory import Recording as Recording
from .trial_log import TrialEntry as TrialEntry
from .trial_log import TrialLog as TrialLog

__all__ = [
    "Observation",
    "Plant",
    "PlantStatus",
    "Recording",
    "RecordingPlant",
    "ReplayedPlant",
    "TrialEntry",
    "TrialLog",
]
