"""What the robot is: hands and objects as data, read from URDF and transmission files."""

from __future__ import annotations

from .digests import file_digests
from .hand import Actuator, ContactPad, HallSensor, HandDescription
from .mimic import Mimic
from .objects import ObjectDescription
from .registry import (
    hand_paths,
    list_cylinders,
    list_hands,
    list_objects,
    load_hand,
    load_object,
    object_paths,
    urdf_folder,
)
from .shape import Shape
from .template import write_template
from .transmission_file import write_transmission
from .urdf import UrdfJoint, UrdfLink, UrdfModel, read_urdf

__all__ = [
    "Actuator",
    "ContactPad",
    "HallSensor",
    "HandDescription",
    "Mimic",
    "ObjectDescription",
    "Shape",
    "UrdfJoint",
    "UrdfLink",
    "UrdfModel",
    "urdf_folder",
    "hand_paths",
    "list_cylinders",
    "list_hands",
    "list_objects",
    "load_hand",
    "load_object",
    "object_paths",
    "read_urdf",
    "write_template",
    "write_transmission",
    "file_digests",
]
