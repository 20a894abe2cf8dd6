"""Planning of a whole turn on f + g: what a sequence of motions does, and which sequence to begin with."""

from __future__ import annotations

from .blind_pose import BlindPose
from .friction_share import friction_share
from .horizon_controller import HorizonController
from .limits import SlipLimit
from .model_hand import ModelHand
from .pose_filter import BlindOptions, PoseFilter
from .prediction import Prediction
from .reach import BeyondReach, Reach, ReachEnd, reachable
from .rollout import Rollout

__all__ = [
    "BeyondReach",
    "BlindOptions",
    "BlindPose",
    "HorizonController",
    "ModelHand",
    "PoseFilter",
    "Prediction",
    "Reach",
    "ReachEnd",
    "Rollout",
    "SlipLimit",
    "friction_share",
    "reachable",
]
