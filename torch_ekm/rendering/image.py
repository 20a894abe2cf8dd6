"""Still pictures of a scene."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ..exceptions import EKMError
from . import drawing
from .scene import Scene, shape_mesh


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
        require("pyvista")
        self._plotter = drawing.Plotter(_meshes(scene), len(scene.transforms), size, smooth)

    def draw(self, scene: Scene, camera: drawing.Camera | None = None) -> NDArray[np.uint8]:
        """A scene of the same shapes, ``(height, width, 3)``.

        Args:
            camera: position, focus and up; that of the scene if None.
        """
        return self._plotter.draw(scene.transforms, camera or scene.camera)

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
    given = pickle.dumps((_meshes(scene), scene.transforms, scene.camera, path, (size, size * 3 // 4)))
    # -P: modules beside the file are not imported by their bare names
    command = [sys.executable, "-P", drawing.__file__]
    done = subprocess.run(command, input=given, capture_output=True, check=False)
    if done.returncode != 0 or not path.exists():
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        remedy = "without a screen and OpenGL it needs VTK 9.5 or newer"
        raise EKMError(f"PyVista could not draw {path} (exit status {done.returncode}); {remedy}: {said}")
    return path


def _meshes(scene: Scene) -> list[drawing.Drawn]:
    meshes = [(shape_mesh(shape), colour) for shape, colour in scene.shapes]
    return [
        (np.array(mesh.vertices), np.array(mesh.faces), colour, scene.opacity(i))
        for i, (mesh, colour) in enumerate(meshes)
    ]
