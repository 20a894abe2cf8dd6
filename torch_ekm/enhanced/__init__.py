"""The enhanced model f + g."""

from __future__ import annotations

from ..estimation.filters import ParameterFilter
from .adaptive_model import AdaptiveModel
from .enhanced_model import EnhancedModel, load, save
from .grasp import GraspEncoding, grasp_learner

__all__ = [
    "AdaptiveModel",
    "EnhancedModel",
    "GraspEncoding",
    "ParameterFilter",
    "grasp_learner",
    "load",
    "save",
]
