"""Ground truth: a simulated hand, and what its cameras and Hall sensors see."""

from __future__ import annotations

from .config import PlantConfig
from .disturbances import Change, DisturbedPlant, Tug
from .fuzzed_plant import FuzzedPlant
from .grasp_planning.pinch import PinchPlan
from .hall_sensors import HallQuality, HallSensors, Stuck
from .imaging.card_scene import CardScene, ConvexBody, PlacedCard
from .imaging.grasp_view import GraspView
from .imaging.simulated_camera import ImageQuality, SimulatedCamera
from .imaging.simulated_video import SimulatedVideo
from .parameters import PlantParameters
from .presets import PRESETS, preset
from .sensed_plant import ICUB_PALM_MOUNT, SensedPlant
from .simulated_hand import PlantSnapshot, SimulatedHand

__all__ = [
    "CardScene",
    "Change",
    "ConvexBody",
    "DisturbedPlant",
    "FuzzedPlant",
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
    "SensedPlant",
    "SimulatedCamera",
    "SimulatedHand",
    "SimulatedVideo",
    "Stuck",
    "Tug",
    "preset",
]
