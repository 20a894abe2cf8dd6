"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .expected_forces import ExpectedForces
from .kinematic_model import KinematicModel
from .linearization import GraspForces, Linearization
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
