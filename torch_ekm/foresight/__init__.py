"""What a sequence of motions does by f + g, how far a grasp turns, and turns with the camera off."""

from __future__ import annotations

from .blind_pose import BlindPose
from .model_hand import ModelHand
from .prediction import Prediction
from .reach import BeyondReach, Reach, ReachEnd, reachable
from .rollout import Rollout

__all__ = [
    "BeyondReach",
    "BlindPose",
    "ModelHand",
    "Prediction",
    "Reach",
    "ReachEnd",
    "Rollout",
    "reachable",
]
