"""HOW the hand touches the object: contacts, grasp matrices, contact forces."""

from .collision import ContactDetector as ContactDetector
from .contact_force import ForceOptions as ForceOptions
from .contact_force import ForceStatus as ForceStatus
from .contact_force import contact_forces as contact_forces
from .contact_kinematics import ContactKinematics as ContactKinematics
from .contact_kinematics import constraint_matrix as constraint_matrix
from .contact_kinematics import contact_kinematics as contact_kinematics
from .contact_kinematics import grasp_matrix as grasp_matrix
from .contact_kinematics import hand_jacobian as hand_jacobian
from .contact_model import ContactModel as ContactModel
from .contact_set import ContactSet as ContactSet
from .grasp import GraspAnalysis as GraspAnalysis
from .grasp import analyse as analyse
from .grasp import ferrari_canny as ferrari_canny
from .grasp import has_force_closure as has_force_closure
from .grasp import null_space as null_space
from .surface import TrackedContacts as TrackedContacts
