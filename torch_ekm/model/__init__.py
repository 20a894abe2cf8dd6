"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .kinematic_model import KinematicModel as KinematicModel
from .linearization import GraspForces as GraspForces
from .linearization import Linearization as Linearization
from .linearization import ModelStatus as ModelStatus
from .options import ModelOptions as ModelOptions

__all__ = [
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
]
