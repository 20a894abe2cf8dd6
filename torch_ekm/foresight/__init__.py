"""What a sequence of motions does by f + g, and turns with the camera off."""

from __future__ import annotations

from .blind_pose import BlindPose

__all__ = ["BlindPose"]
