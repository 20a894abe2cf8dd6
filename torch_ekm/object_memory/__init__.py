"""Which object is held: models of familiar objects, recognised by the forces and angles of a grasp."""

from __future__ import annotations

from .grasp_signature import GraspSignature
from .model_bank import ModelBank
from .signature_model import SignatureModel

__all__ = [
    "GraspSignature",
    "ModelBank",
    "SignatureModel",
]
