"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .calibration import Calibration, calibrate
from .kinematic_model import KinematicModel
from .linearization import GraspForces, Linearization, ModelStatus
from .options import ModelOptions
from .projection import Projection, project_onto_contacts

__all__ = [
    "Calibration",
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
    "Projection",
    "calibrate",
    "project_onto_contacts",
]
