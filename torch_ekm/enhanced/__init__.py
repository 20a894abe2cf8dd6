"""The enhanced model f + g."""

from __future__ import annotations

from ..estimation.parameter_filter import ParameterFilter
from .adaptive_model import AdaptiveModel
from .enhanced_model import EnhancedModel
from .grasp import GraspEncoding, grasp_learner
from .saving import load, save

__all__ = [
    "AdaptiveModel",
    "EnhancedModel",
    "GraspEncoding",
    "ParameterFilter",
    "grasp_learner",
    "load",
    "save",
]
