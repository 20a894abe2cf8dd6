"""Ground truth: a simulated hand, and what its cameras and Hall sensors see."""

from __future__ import annotations

from .config import PlantConfig
from .disturbances import DisturbedPlant, PlantChange, Tug
from .hall_sensors import HallSensors
from .imaging.simulated_camera import SimulatedCamera
from .parameters import PlantParameters
from .physics.scene import ENGINES
from .presets import PRESETS, preset
from .sensed_plant import SensedPlant
from .simulated_hand import SimulatedHand

__all__ = [
    "ENGINES",
    "PlantChange",
    "DisturbedPlant",
    "HallSensors",
    "PlantConfig",
    "PlantParameters",
    "PRESETS",
    "SensedPlant",
    "SimulatedCamera",
    "SimulatedHand",
    "Tug",
    "preset",
]
