"""The whole turn planned on f + g: what a sequence of motions does, and which sequence to begin with."""

from __future__ import annotations

from .blind_pose import BlindPose
from .model_hand import ModelHand
from .pose_filter import BlindOptions, PoseFilter
from .reach import BeyondReach, Reach, ReachEnd, reachable

__all__ = [
    "BeyondReach",
    "BlindOptions",
    "BlindPose",
    "ModelHand",
    "PoseFilter",
    "Reach",
    "ReachEnd",
    "reachable",
]
