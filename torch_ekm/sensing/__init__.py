"""From raw readings to joint angles and poses.

Vision: :class:`MarkerTracker` turns images into the object's pose in the hand frame. Hall sensors:
:class:`HallCalibration` turns counts into angles, :class:`JointEstimator` joins them with the encoders,
:class:`ContactAligned` corrects the joints that no sensor reads. The same code serves simulated and real
readings."""

from __future__ import annotations

from .camera import MarkerBoard, PinholeCamera
from .contact_alignment import ContactAligned
from .joint_estimator import HallCalibration, JointEstimator
from .tracker import MarkerTracker, Track, TrackStatus

__all__ = [
    "HallCalibration",
    "JointEstimator",
    "MarkerBoard",
    "MarkerTracker",
    "PinholeCamera",
    "ContactAligned",
    "Track",
    "TrackStatus",
]
