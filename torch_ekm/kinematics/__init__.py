"""WHERE its points are: forward kinematics, Jacobians, the actuation map."""

from .actuation import ActuationMap as ActuationMap
from .hand_kinematics import HandKinematics as HandKinematics
from .link_poses import LinkPoses as LinkPoses

__all__ = ["ActuationMap", "HandKinematics", "LinkPoses"]
