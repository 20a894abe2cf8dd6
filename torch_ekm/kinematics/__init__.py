"""WHERE its points are: forward kinematics, Jacobians, the actuation map."""

from __future__ import annotations

from .actuation import ActuationMap as ActuationMap
from .grasp_state import GraspState as GraspState
from .hand_kinematics import HandKinematics as HandKinematics
from .link_poses import LinkPoses as LinkPoses

__all__ = [
    "ActuationMap",
    "GraspState",
    "HandKinematics",
    "LinkPoses",
]
