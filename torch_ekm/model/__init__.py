"""The kinematic model: equilibrium, stiffness, and the manipulation Jacobian of an elastic hand."""

from .kinematic_model import KinematicModel as KinematicModel
from .linearization import GraspForces as GraspForces
from .linearization import Linearization as Linearization
from .linearization import ModelStatus as ModelStatus
from .options import ModelOptions as ModelOptions
from .state import GraspState as GraspState
