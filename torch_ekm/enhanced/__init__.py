"""The enhanced model f + g."""

from .encoding import GraspEncoding as GraspEncoding
from .enhanced_model import EnhancedModel as EnhancedModel
from .grasp_signature import GraspSignature as GraspSignature
from .model_bank import ModelBank as ModelBank
from .signature_model import SignatureModel as SignatureModel

__all__ = ["EnhancedModel", "GraspEncoding", "GraspSignature", "ModelBank", "SignatureModel"]
