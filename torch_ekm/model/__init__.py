"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .grasp_forces import ExpectedForces, GraspForces
from .kinematic_model import KinematicModel
from .linearization import Linearization
from .options import ModelOptions
from .validity import Doubt, ModelStatus

__all__ = [
    "Doubt",
    "ExpectedForces",
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
]
