"""Checks for authors of learners and drivers: the contract of a learner, a plant that spoils its readings,
a bus of servos without servos.

Needs torch alone; nothing here is used by the package itself.
"""

from __future__ import annotations

from .dynamixel_bus import DynamixelBus
from .fuzzed_plant import FuzzedPlant
from .learner_contract import check_residual_learner
from .motors import Motors

__all__ = ["DynamixelBus", "FuzzedPlant", "Motors", "check_residual_learner"]
