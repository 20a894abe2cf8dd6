"""The enhanced model f + g."""

from __future__ import annotations

from .encoding import GraspEncoding
from .enhanced_model import EnhancedModel
from .grasp_learner import grasp_learner
from .saving import load, save

__all__ = [
    "EnhancedModel",
    "GraspEncoding",
    "grasp_learner",
    "load",
    "save",
]
