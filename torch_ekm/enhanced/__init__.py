"""The enhanced model f + g."""

from __future__ import annotations

from .action_variance import Quadratic
from .encoding import GraspEncoding
from .enhanced_model import EnhancedModel
from .grasp_learner import grasp_learner
from .saving import load, save
from .trust_region import TrustOptions, TrustRegion

__all__ = [
    "EnhancedModel",
    "GraspEncoding",
    "Quadratic",
    "TrustOptions",
    "TrustRegion",
    "grasp_learner",
    "load",
    "save",
]
