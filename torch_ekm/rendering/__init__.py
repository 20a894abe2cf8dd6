"""Pictures of a hand and its object: still images, and pages on which it can be turned and zoomed."""

from __future__ import annotations

from .drawing import Picture
from .scene import Scene, make_scene, save_picture
from .web import Captions, save_animation

__all__ = [
    "Captions",
    "Picture",
    "Scene",
    "make_scene",
    "save_animation",
    "save_picture",
]
