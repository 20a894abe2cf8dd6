"""The enhanced model f + g."""

from __future__ import annotations

from .action_variance import Quadratic
from .encoding import GraspEncoding
from .enhanced_model import EnhancedModel
from .grasp_learner import grasp_learner
from .saving import load, save

__all__ = [
    "EnhancedModel",
    "GraspEncoding",
    "Quadratic",
    "grasp_learner",
    "load",
    "save",
]
