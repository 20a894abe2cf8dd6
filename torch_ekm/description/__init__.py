"""WHAT the robot is: hands and objects as data, read from URDF and transmission files."""

from __future__ import annotations

from .hand import Actuator as Actuator
from .hand import ContactPad as ContactPad
from .hand import HallSensor as HallSensor
from .hand import HandDescription as HandDescription
from .objects import ObjectDescription as ObjectDescription
from .registry import hand_paths as hand_paths
from .registry import list_hands as list_hands
from .registry import list_objects as list_objects
from .registry import load_hand as load_hand
from .registry import load_object as load_object
from .registry import object_paths as object_paths
from .registry import urdf_folder as urdf_folder
from .shape import Shape as Shape
from .urdf import UrdfJoint as UrdfJoint
from .urdf import UrdfLink as UrdfLink
from .urdf import UrdfModel as UrdfModel
from .urdf import read_urdf as read_urdf

__all__ = [
    "Actuator",
    "ContactPad",
    "HallSensor",
    "HandDescription",
    "ObjectDescription",
    "Shape",
    "UrdfJoint",
    "UrdfLink",
    "UrdfModel",
    "urdf_folder",
    "hand_paths",
    "list_hands",
    "list_objects",
    "load_hand",
    "load_object",
    "object_paths",
    "read_urdf",
]
