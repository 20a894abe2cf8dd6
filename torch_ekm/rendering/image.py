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

    An OpenGL that is broken or missing can abort the whole process, so PyVista draws in a process of its
    own; if that fails, matplotlib draws a plainer picture.
    """
    scene = replace(scene, transforms=scene.transforms[list(frames)])
    given = pickle.dumps((scene, path, (size, size * 3 // 4)))
    try:
        command = [sys.executable, "-c", _DRAW]
        done = subprocess.run(command, input=given, capture_output=True, timeout=120, check=False)
        drawn = done.returncode == 0 and path.exists()
    except subprocess.TimeoutExpired:
        drawn = False
    if not drawn:
        _draw_matplotlib(scene, path, size)
    return path


def _draw_matplotlib(scene: Scene, path: Path, size: int) -> None:
    collection = require("mpl_toolkits.mplot3d.art3d").Poly3DCollection
    n = len(scene.transforms)
    figure = require("matplotlib.figure").Figure(figsize=(size / 100 * n, size / 100))
    meshes = [(shape_mesh(shape), colour, scene.opacity(i)) for i, (shape, colour) in enumerate(scene.shapes)]
    position, focus, up = scene.camera  # matplotlib's z is up in the picture: turn everything there
    forward = np.eye(3)[int(abs(up[0]) > 0.99)]  # any direction that is not up
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    turn = np.stack([forward, np.cross(up, forward), up])
    sight = turn @ (position - focus)
    azimuth = np.degrees(np.arctan2(sight[1], sight[0]))
    elevation = np.degrees(np.arcsin(sight[2] / np.linalg.norm(sight)))
    for k, transforms in enumerate(scene.transforms):
        axis = figure.add_subplot(1, n, k + 1, projection="3d")
        for (mesh, colour, opacity), T in zip(meshes, transforms, strict=True):
            vertices = (mesh.vertices @ T[:3, :3].T + T[:3, 3]) @ turn.T
            faces = collection(vertices[mesh.faces], facecolors=colour, shade=True, alpha=opacity)
            axis.add_collection3d(faces)
        for name, middle in zip("xyz", turn @ focus, strict=True):
            getattr(axis, f"set_{name}lim")(middle - 0.06, middle + 0.06)
        axis.set_axis_off()
        axis.set_box_aspect((1, 1, 1), zoom=1.4)
        axis.view_init(elev=elevation, azim=azimuth)
    figure.savefig(path, dpi=100)
