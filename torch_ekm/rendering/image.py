"""Still pictures of a scene."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ..exceptions import EKMError
from ..typing import Array
from .scene import Scene, shape_mesh

_DRAW = """
import pickle, sys
from torch_ekm.rendering import Picture
scene, path, size = pickle.load(sys.stdin.buffer)
Picture(scene, size, smooth=True).draw(scene, path)
"""


class Picture:
    """The frames of a scene side by side, drawn off screen by PyVista, as often as they change.

    Args:
        scene: gives the shapes and the number of frames.
        size: width and height of one frame [pixel].
        smooth: without jagged edges; takes longer.

    Raises:
        MissingExtraError: pyvista or trimesh is not installed.
    """

    def __init__(self, scene: Scene, size: tuple[int, int] = (480, 360), smooth: bool = False) -> None:
        pyvista, n = require("pyvista"), len(scene.transforms)
        self._plotter: Any = pyvista.Plotter(
            off_screen=True, shape=(1, n), border=False, window_size=(n * size[0], size[1])
        )
        meshes = [
            (pyvista.wrap(shape_mesh(shape)), colour, scene.opacity(i))
            for i, (shape, colour) in enumerate(scene.shapes)
        ]
        look = {"smooth_shading": True, "split_sharp_edges": True, "specular": 0.3, "specular_power": 15}
        self._actors = []
        for k in range(n):
            self._plotter.subplot(0, k)
            self._plotter.set_background("white")
            self._actors.append([self._plotter.add_mesh(m, color=c, opacity=o, **look) for m, c, o in meshes])
            if smooth:
                self._plotter.enable_anti_aliasing("ssaa")

    def draw(
        self, scene: Scene, path: Path | None = None, camera: tuple[Array, Array, Array] | None = None
    ) -> NDArray[np.uint8]:
        """A scene of the same shapes, ``(height, width, 3)``; also written to ``path``.

        Args:
            camera: position, focus and up; that of the scene if None.
        """
        for k, actors in enumerate(self._actors):
            self._plotter.subplot(0, k)
            for actor, transform in zip(actors, scene.transforms[k], strict=True):
                actor.user_matrix = transform
            self._plotter.camera_position = [tuple(part) for part in camera or scene.camera]
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(path, return_img=True), dtype=np.uint8)[..., :3]

    def close(self) -> None:
        """Close the off-screen window and release its memory."""
        self._plotter.close()


def save_picture(scene: Scene, path: Path, frames: Sequence[int] = (-1,), size: int = 640) -> Path:
    """Draw some frames side by side, each ``size`` pixels wide.

    An OpenGL that is broken can abort the whole process, so PyVista draws in a process of its own.

    Raises:
        MissingExtraError: pyvista or trimesh is not installed.
        EKMError: PyVista cannot draw on this machine, or ``path`` cannot be written; the message ends with
            what it says.
    """
    require("pyvista")
    scene = replace(scene, transforms=scene.transforms[list(frames)])
    given = pickle.dumps((scene, path, (size, size * 3 // 4)))
    done = subprocess.run([sys.executable, "-c", _DRAW], input=given, capture_output=True, check=False)
    if done.returncode != 0 or not path.exists():
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        remedy = "without a screen and OpenGL it needs VTK 9.5 or newer"
        raise EKMError(f"PyVista could not draw {path} (exit status {done.returncode}); {remedy}: {said}")
    return path
