"""Drivers of real hands: one TOML file each, and one base for what all have in common.

Tested against the genuine protocols; none was tried on hardware.
"""

from __future__ import annotations

from .driver import HandDriver
from .dynamixel import DynamixelPlant
from .dynamixel_port import SERVOS, Servo
from .emulated import EmulatedPlant
from .gathered import BusReading
from .opening import open_driver
from .pose import MarkerPose, Sighting, WithPose
from .ros2 import Ros2Plant, RosPose
from .wiring import Channel, Limits, Wiring
from .yarp import YarpPlant

__all__ = [
    "SERVOS",
    "BusReading",
    "Channel",
    "DynamixelPlant",
    "EmulatedPlant",
    "HandDriver",
    "Limits",
    "MarkerPose",
    "Ros2Plant",
    "RosPose",
    "Servo",
    "Sighting",
    "WithPose",
    "Wiring",
    "YarpPlant",
    "open_driver",
]
