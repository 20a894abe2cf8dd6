"""Where the hand's points are: forward kinematics, Jacobians, the actuation map."""

from __future__ import annotations

from .actuation import ActuationMap
from .grasp_state import GraspState
from .hand_kinematics import HandKinematics
from .link_poses import LinkPoses
from .play import Play
from .servo_model import ServoModel

__all__ = ["ActuationMap", "GraspState", "HandKinematics", "LinkPoses", "Play", "ServoModel"]
