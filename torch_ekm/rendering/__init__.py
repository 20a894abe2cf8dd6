"""Pictures of a hand and its object: still ones, and pages to turn and zoom."""

from __future__ import annotations

from .image import Picture as Picture
from .image import save_picture as save_picture
from .scene import Scene as Scene
from .scene import make_scene as make_scene
from .web import draw as draw
from .web import place as place
from .web import save_animation as save_animation
from .web import start_server as start_server

__all__ = [
    "Picture",
    "Scene",
    "draw",
    "make_scene",
    "place",
    "save_animation",
    "save_picture",
    "start_server",
]
