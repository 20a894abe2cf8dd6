"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .calibration import Calibration, calibrate
from .grasp_forces import ExpectedForces, GraspForces
from .kinematic_model import KinematicModel
from .linearization import Linearization
from .options import ModelOptions
from .projection import Projection, project_onto_contacts
from .validity import Doubt, ModelStatus

__all__ = [
    "Calibration",
    "Doubt",
    "ExpectedForces",
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
    "Projection",
    "calibrate",
    "project_onto_contacts",
]
