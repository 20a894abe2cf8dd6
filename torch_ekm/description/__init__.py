"""What the robot is: hands and objects as data, read from URDF and transmission files."""

from __future__ import annotations

from .hand import Actuator, ContactPad, HandDescription
from .objects import ObjectDescription
from .registry import list_hands, list_objects, load_hand, load_object
from .shape import Shape
from .transmission_file import write_template, write_transmission

__all__ = [
    "Actuator",
    "ContactPad",
    "HandDescription",
    "ObjectDescription",
    "Shape",
    "list_hands",
    "list_objects",
    "load_hand",
    "load_object",
    "write_template",
    "write_transmission",
]
