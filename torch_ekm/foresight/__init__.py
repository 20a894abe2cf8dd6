"""Turns with the camera off: the object's pose from the model, the joints and the fingertips."""

from __future__ import annotations

from .blind_pose import BlindPose

__all__ = ["BlindPose"]
