"""How the hand touches the object: contacts, grasp matrices, contact forces."""

from __future__ import annotations

from .contact_kinematics import (
    ContactKinematics,
    constraint_matrix,
    contact_kinematics,
    grasp_matrix,
    hand_jacobian,
)
from .contact_set import ContactSet
from .detector import ContactDetector
from .forces.problem import ForceOptions, ForceStatus
from .forces.solve import contact_forces
from .grasp_analysis import analyse
from .signed_distance import signed_distance

__all__ = [
    "ContactDetector",
    "ContactKinematics",
    "ContactSet",
    "ForceOptions",
    "ForceStatus",
    "analyse",
    "constraint_matrix",
    "contact_forces",
    "contact_kinematics",
    "grasp_matrix",
    "hand_jacobian",
    "signed_distance",
]
