"""The enhanced model f + g."""

from .encoding import GraspEncoding as GraspEncoding
from .enhanced_model import EnhancedModel as EnhancedModel
from .model_bank import ModelBank as ModelBank

__all__ = ["EnhancedModel", "GraspEncoding", "ModelBank"]
