"""Pictures of a hand and its object: still images, and pages on which it can be turned and zoomed."""

from __future__ import annotations

from .image import Picture, save_picture
from .scene import Scene, make_scene
from .web import Told, pad_forces, save_animation

__all__ = [
    "Picture",
    "Scene",
    "Told",
    "make_scene",
    "pad_forces",
    "save_animation",
    "save_picture",
]
