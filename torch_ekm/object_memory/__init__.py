"""WHICH object is it: models of familiar objects, recognised by what a grasp feels like."""

from __future__ import annotations

from .grasp_signature import GraspSignature
from .model_bank import ModelBank
from .signature_model import SignatureModel

__all__ = [
    "GraspSignature",
    "ModelBank",
    "SignatureModel",
]
