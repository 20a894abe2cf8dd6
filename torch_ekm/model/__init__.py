"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .kinematic_model import KinematicModel
from .linearization import GraspForces, Linearization, ModelStatus
from .options import ModelOptions

__all__ = [
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
]
