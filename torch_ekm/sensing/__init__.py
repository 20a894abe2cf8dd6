"""From raw readings to joint angles and poses.

Vision: an image source gives frames, :class:`MarkerTracker` turns them into the object's pose in the hand
frame. Hall sensors: :class:`HallCalibration` turns counts into angles, :class:`JointEstimator` joins them
with the encoders, :class:`ContactAligned` corrects the joints that no sensor reads. The same code serves
simulated and real readings."""

from __future__ import annotations

from .contact_alignment import ContactAligned as ContactAligned
from .hall.calibration import HallCalibration as HallCalibration
from .hall.calibration import HallEstimate as HallEstimate
from .hall.channel import HallChannel as HallChannel
from .joint_estimator import JointEstimate as JointEstimate
from .joint_estimator import JointEstimator as JointEstimator
from .vision.board import MarkerBoard as MarkerBoard
from .vision.board_pose import BoardPose as BoardPose
from .vision.board_pose import estimate_board_pose as estimate_board_pose
from .vision.calibration import CameraCalibration as CameraCalibration
from .vision.calibration import calibrate_camera as calibrate_camera
from .vision.camera import PinholeCamera as PinholeCamera
from .vision.charuco import CharucoTarget as CharucoTarget
from .vision.edge_refinement import refine_on_edges as refine_on_edges
from .vision.image_folder import ImageFolder as ImageFolder
from .vision.sources import Frame as Frame
from .vision.sources import ImageSource as ImageSource
from .vision.sources import StreamOptions as StreamOptions
from .vision.track import Track as Track
from .vision.track import TrackStatus as TrackStatus
from .vision.tracker import MarkerTracker as MarkerTracker
from .vision.tracker import TrackerOptions as TrackerOptions
from .vision.video_capture import VideoCapture as VideoCapture

__all__ = [
    "BoardPose",
    "CameraCalibration",
    "CharucoTarget",
    "Frame",
    "HallCalibration",
    "HallChannel",
    "HallEstimate",
    "ImageFolder",
    "ImageSource",
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
    "estimate_board_pose",
    "refine_on_edges",
]
