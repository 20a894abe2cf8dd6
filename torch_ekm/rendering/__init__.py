"""Pictures of a hand and its object: still images, and pages on which it can be turned and zoomed."""

from __future__ import annotations

from .image import Picture, save_picture
from .scene import Scene, make_scene
from .visuals import visuals
from .web import draw, place, save_animation, start_server

__all__ = [
    "Picture",
    "Scene",
    "draw",
    "make_scene",
    "place",
    "save_animation",
    "save_picture",
    "start_server",
    "visuals",
]
