"""What a sequence of motions does by f + g, and turns with the camera off."""

from __future__ import annotations

from .blind_pose import BlindPose
from .prediction import Prediction
from .rollout import Rollout

__all__ = ["BlindPose", "Prediction", "Rollout"]
