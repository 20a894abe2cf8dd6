"""Ground truth: a simulated hand, and what its cameras and Hall sensors see."""

from __future__ import annotations

from .config import PlantConfig as PlantConfig
from .disturbances import Change as Change
from .disturbances import DisturbedPlant as DisturbedPlant
from .disturbances import Tug as Tug
from .grasp_planning.pinch import PinchPlan as PinchPlan
from .hall_sensors import HallQuality as HallQuality
from .hall_sensors import HallSensors as HallSensors
from .hall_sensors import Stuck as Stuck
from .imaging.card_scene import CardScene as CardScene
from .imaging.card_scene import ConvexBody as ConvexBody
from .imaging.card_scene import PlacedCard as PlacedCard
from .imaging.grasp_view import GraspView as GraspView
from .imaging.sapien_camera import SapienCamera as SapienCamera
from .imaging.simulated_camera import ImageQuality as ImageQuality
from .imaging.simulated_camera import SimulatedCamera as SimulatedCamera
from .imaging.simulated_video import SimulatedVideo as SimulatedVideo
from .parameters import PlantParameters as PlantParameters
from .presets import PRESETS as PRESETS
from .presets import preset as preset
from .sensed_plant import ICUB_PALM_MOUNT as ICUB_PALM_MOUNT
from .sensed_plant import SensedPlant as SensedPlant
from .simulated_hand import PlantSnapshot as PlantSnapshot
from .simulated_hand import SimulatedHand as SimulatedHand

__all__ = [
    "CardScene",
    "Change",
    "ConvexBody",
    "DisturbedPlant",
    "GraspView",
    "HallQuality",
    "HallSensors",
    "ICUB_PALM_MOUNT",
    "ImageQuality",
    "PinchPlan",
    "PlacedCard",
    "PlantConfig",
    "PlantParameters",
    "PlantSnapshot",
    "PRESETS",
    "SapienCamera",
    "SensedPlant",
    "SimulatedCamera",
    "SimulatedHand",
    "SimulatedVideo",
    "Stuck",
    "Tug",
    "preset",
]
