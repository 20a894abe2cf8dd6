"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .calibration import calibrate
from .grasp_forces import GraspForces
from .kinematic_model import KinematicModel
from .linearization import Linearization
from .options import ModelOptions
from .validity import ModelStatus

__all__ = [
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
    "calibrate",
]
