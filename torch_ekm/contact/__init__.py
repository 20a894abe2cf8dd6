"""How the hand touches the object: contacts, grasp matrices, contact forces."""

from __future__ import annotations

from .contacts import (
    ContactKinematics,
    ContactSet,
    analyse,
    constraint_matrix,
    contact_kinematics,
    grasp_matrix,
    hand_jacobian,
)
from .detector import ContactDetector
from .forces import ForceOptions, ForceStatus, contact_forces
from .pad_contact import signed_distance

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
