"""The whole turn planned on f + g: what a sequence of motions does, and which sequence to begin with."""

from __future__ import annotations

from .blind_pose import BlindPose
from .pose_filter import BlindOptions, PoseFilter

__all__ = ["BlindOptions", "BlindPose", "PoseFilter"]
