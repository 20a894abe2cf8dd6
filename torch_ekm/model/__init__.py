"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from __future__ import annotations

from .contact_motion import ContactMode, ContactMotion, ContactStep
from .grasp_forces import GraspForces
from .kinematic_model import KinematicModel
from .linearization import Linearization
from .validity import ModelOptions, ModelStatus

__all__ = [
    "ContactMode",
    "ContactMotion",
    "ContactStep",
    "GraspForces",
    "KinematicModel",
    "Linearization",
    "ModelOptions",
    "ModelStatus",
]
