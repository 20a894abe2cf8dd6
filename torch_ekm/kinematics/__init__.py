"""Where the hand's points are: forward kinematics, Jacobians, the actuation map."""

from __future__ import annotations

from .equilibrium import ActuationMap
from .poses import GraspState, HandKinematics, LinkPoses
from .servo_model import Play, ServoModel

__all__ = ["ActuationMap", "GraspState", "HandKinematics", "LinkPoses", "Play", "ServoModel"]
