"""From raw readings to joint angles and poses.

Vision: :class:`MarkerTracker` turns images (of any ``Iterable[Frame]``) into the object's pose in the hand
frame. Hall sensors: :class:`HallCalibration` turns counts into angles, :class:`JointEstimator` joins them
with the encoders, :class:`ContactAligned` corrects the joints that no sensor reads, :class:`FingerMarkers`
reads angles from markers on the links. The same code serves simulated and real readings."""

from __future__ import annotations

from .contact_alignment import ContactAligned
from .finger_markers import FingerMarkers, calibrate_markers
from .hall.calibration import HallCalibration, HallEstimate
from .hall.channel import HallChannel
from .joint_estimator import JointEstimate, JointEstimator
from .vision.board import MarkerBoard
from .vision.board_pose import BoardPose, estimate_board_pose
from .vision.calibration import CameraCalibration, calibrate_camera
from .vision.camera import PinholeCamera
from .vision.charuco import CharucoTarget
from .vision.edge_refinement import refine_on_edges
from .vision.image_folder import ImageFolder
from .vision.sources import Frame, StreamOptions
from .vision.track import Track, TrackStatus
from .vision.tracker import MarkerTracker, TrackerOptions
from .vision.video_capture import VideoCapture

__all__ = [
    "BoardPose",
    "CameraCalibration",
    "CharucoTarget",
    "FingerMarkers",
    "Frame",
    "HallCalibration",
    "HallChannel",
    "HallEstimate",
    "ImageFolder",
    "JointEstimate",
    "JointEstimator",
    "MarkerBoard",
    "MarkerTracker",
    "PinholeCamera",
    "StreamOptions",
    "ContactAligned",
    "Track",
    "TrackStatus",
    "TrackerOptions",
    "VideoCapture",
    "calibrate_camera",
    "calibrate_markers",
    "estimate_board_pose",
    "refine_on_edges",
]
