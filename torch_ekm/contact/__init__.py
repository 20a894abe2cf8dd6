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
from .forces.problem import ForceOptions as ForceOptions
from .forces.problem import ForceStatus as ForceStatus
from .forces.problem import contact_forces as contact_forces
from .grasp_analysis import GraspAnalysis as GraspAnalysis
from .grasp_analysis import analyse as analyse
from .grasp_analysis import ferrari_canny as ferrari_canny
from .grasp_analysis import has_force_closure as has_force_closure
from .grasp_analysis import null_space as null_space
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
    "ferrari_canny",
    "grasp_matrix",
    "hand_jacobian",
    "has_force_closure",
    "null_space",
]
