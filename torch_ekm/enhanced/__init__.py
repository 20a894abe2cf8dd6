"""The enhanced model f + g."""

from __future__ import annotations

from .action_variance import Quadratic as Quadratic
from .encoding import GraspEncoding as GraspEncoding
from .enhanced_model import EnhancedModel as EnhancedModel
from .grasp_learner import grasp_learner as grasp_learner

__all__ = [
    "EnhancedModel",
    "GraspEncoding",
    "Quadratic",
    "grasp_learner",
]
