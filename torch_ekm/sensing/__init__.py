"""From raw readings to joint angles and poses.

Vision: an image source gives frames, :class:`MarkerTracker` turns them into the object's pose in the hand
frame. Hall sensors: :class:`HallCalibration` turns counts into angles, :class:`JointEstimator` joins them
with the encoders, :class:`TouchAligned` corrects the joints that no sensor reads. The same code serves
simulated and real readings.
"""

from .board import MarkerBoard as MarkerBoard
from .board_pose import BoardPose as BoardPose
from .board_pose import estimate_board_pose as estimate_board_pose
from .calibration import CameraCalibration as CameraCalibration
from .calibration import calibrate_camera as calibrate_camera
from .camera import PinholeCamera as PinholeCamera
from .charuco import CharucoTarget as CharucoTarget
from .edge_pose import refine_on_edges as refine_on_edges
from .frame import Frame as Frame
from .frame import ImageSource as ImageSource
from .frame import StreamOptions as StreamOptions
from .grasp_view import GraspView as GraspView
from .hall import HallCalibration as HallCalibration
from .hall import HallEstimate as HallEstimate
from .hall_channel import HallChannel as HallChannel
from .hall_sensors import HallQuality as HallQuality
from .hall_sensors import HallSensors as HallSensors
from .hall_sensors import Stuck as Stuck
from .image_folder import ImageFolder as ImageFolder
from .joint_estimator import JointEstimate as JointEstimate
from .joint_estimator import JointEstimator as JointEstimator
from .marker import MarkerTracker as MarkerTracker
from .marker import TrackerOptions as TrackerOptions
from .sapien_camera import SapienCamera as SapienCamera
from .scene import ConvexBody as ConvexBody
from .scene import PlacedCard as PlacedCard
from .scene import Scene as Scene
from .sensed_plant import ICUB_PALM_MOUNT as ICUB_PALM_MOUNT
from .sensed_plant import SensedPlant as SensedPlant
from .simulated_camera import ImageQuality as ImageQuality
from .simulated_camera import SimulatedCamera as SimulatedCamera
from .simulated_video import SimulatedVideo as SimulatedVideo
from .touch import TouchAligned as TouchAligned
from .track import Track as Track
from .track import TrackStatus as TrackStatus
from .video_capture import VideoCapture as VideoCapture

__all__ = [
    "BoardPose",
    "CameraCalibration",
    "CharucoTarget",
    "ConvexBody",
    "Frame",
    "GraspView",
    "HallCalibration",
    "HallChannel",
    "HallEstimate",
    "HallQuality",
    "HallSensors",
    "ICUB_PALM_MOUNT",
    "ImageFolder",
    "ImageQuality",
    "ImageSource",
    "JointEstimate",
    "JointEstimator",
    "MarkerBoard",
    "MarkerTracker",
    "PinholeCamera",
    "PlacedCard",
    "SapienCamera",
    "Scene",
    "SensedPlant",
    "SimulatedCamera",
    "SimulatedVideo",
    "StreamOptions",
    "Stuck",
    "TouchAligned",
    "Track",
    "TrackStatus",
    "TrackerOptions",
    "VideoCapture",
    "calibrate_camera",
    "estimate_board_pose",
    "refine_on_edges",
]
