"""The enhanced model f + g."""

from __future__ import annotations

from .encoding import GraspEncoding as GraspEncoding
from .enhanced_model import EnhancedModel as EnhancedModel

__all__ = [
    "EnhancedModel",
    "GraspEncoding",
]
