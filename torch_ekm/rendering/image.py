"""Still pictures of a scene."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..exceptions import EKMError
from . import drawing
from .scene import Scene


def save_picture(scene: Scene, path: Path, frames: Sequence[int] = (-1,)) -> Path:
    """Draw some frames side by side, each 640 pixels wide.

    An OpenGL that is broken can abort the whole process, so PyVista draws in a process of its own.

    Raises:
        MissingExtraError: pyvista or trimesh is not installed.
        EKMError: PyVista cannot draw on this machine, or ``path`` cannot be written; the message ends with
            what it says.
    """
    scene = replace(scene, transforms=scene.transforms[list(frames)])
    given = pickle.dumps((scene.meshes, scene.transforms, scene.camera, path, (640, 480)))
    # -P: modules beside the file are not imported by their bare names
    command = [sys.executable, "-P", drawing.__file__]
    done = subprocess.run(command, input=given, capture_output=True, check=False)
    if done.returncode != 0 or not path.exists():
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        remedy = "without a screen and OpenGL it needs VTK 9.5 or newer"
        raise EKMError(f"PyVista could not draw {path} (exit status {done.returncode}); {remedy}: {said}")
    return path
