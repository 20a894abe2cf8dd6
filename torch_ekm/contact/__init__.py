"""HOW the hand touches the object: contacts, grasp matrices, contact forces."""

from __future__ import annotations

from .contact_kinematics import ContactKinematics as ContactKinematics
from .contact_kinematics import constraint_matrix as constraint_matrix
from .contact_kinematics import contact_kinematics as contact_kinematics
from .contact_kinematics import grasp_matrix as grasp_matrix
from .contact_kinematics import hand_jacobian as hand_jacobian
from .contact_model import ContactModel as ContactModel
from .contact_set import ContactSet as ContactSet
from .detector import ContactDetector as ContactDetector
from .forces.balance import ForceStatus as ForceStatus
from .forces.options import ForceOptions as ForceOptions
from .forces.solve import contact_forces as contact_forces
from .grasp_analysis import GraspAnalysis as GraspAnalysis
from .grasp_analysis import analyse as analyse
from .signed_distance import signed_distance as signed_distance
from .surface import TrackedContacts as TrackedContacts

__all__ = [
    "ContactDetector",
    "ContactKinematics",
    "ContactModel",
    "ContactSet",
    "ForceOptions",
    "ForceStatus",
    "GraspAnalysis",
    "TrackedContacts",
    "analyse",
    "constraint_matrix",
    "contact_forces",
    "contact_kinematics",
    "grasp_matrix",
    "hand_jacobian",
    "signed_distance",
]
