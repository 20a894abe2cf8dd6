"""What is drawn of a hand and its object, and from where: along the axis about which the object turns."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._extras import require
from ..description import HandDescription, ObjectDescription, Shape
from ..exceptions import DescriptionError, EKMError
from ..kinematics import HandKinematics
from ..kinematics.se3 import log
from ..typing import Array
from . import drawing
from .visuals import Mesh, visuals

Colour = tuple[float, float, float]

_PALM, _PHALANX, _TIP, _OBJECT = (0.45, 0.47, 0.50), (0.72, 0.74, 0.77), (0.00, 0.45, 0.70), (0.90, 0.62, 0.0)
_GHOST = (0.0, 0.62, 0.45)
_DISTANCE = 0.34  # [m] of the camera
_TURNED = 0.05  # [rad]: a smaller rotation does not determine its axis


@dataclass(frozen=True)
class Scene:
    """Poses of everything that is drawn, in the hand frame; ``frames`` along the first axis."""

    shapes: list[tuple[Shape | Mesh, Colour]]
    transforms: Array
    """``(n_frames, n_shapes, 4, 4)``"""
    down: Array
    """Down in the picture: the direction of gravity, hand frame."""
    side: Array
    """Direction from which the hand is looked at, hand frame."""
    ghosts: int = 0
    """So many of the last shapes are see-through."""

    def opacity(self, shape: int) -> float:
        """Of a shape; 1: it hides what is behind it."""
        return 0.35 if shape >= len(self.shapes) - self.ghosts else 1.0

    @property
    def meshes(self) -> list[drawing.Drawn]:
        """What :class:`Picture` draws.

        Raises:
            MissingExtraError: pyvista or trimesh is not installed.
        """
        require("pyvista")
        meshes = []
        for i, (shape, colour) in enumerate(self.shapes):
            mesh = shape_mesh(shape)
            meshes.append((np.array(mesh.vertices), np.array(mesh.faces), colour, self.opacity(i)))
        return meshes

    @property
    def camera(self) -> tuple[Array, Array, Array]:
        """Position and focus of the camera [m], and up."""
        focus = self.transforms[:, :, :3, 3].reshape(-1, 3).mean(axis=0)
        return focus + _DISTANCE * self.side / np.linalg.norm(self.side), focus, -self.down


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


def make_scene(
    hand: HandDescription,
    obj: ObjectDescription | None,
    q: Array,
    position: Array | None,
    rotation: Array | None,
    gravity: Array,
    ghost: tuple[Array, Array] | None = None,
    axis: Array | None = None,
) -> Scene:
    """Place what is seen of the hand (``<visual>``, else ``<collision>``) and of the object for each frame.

    It is looked at along the axis about which the object turns: ``axis``, else that of the largest rotation
    from the first frame.

    Args:
        q: ``(n_frames, n_q)`` [rad].
        position: ``(n_frames, 3)`` [m].
        rotation: ``(n_frames, 3, 3)``.
        gravity: ``(3,)`` [m/s^2], hand frame, such as ``hand.gravity``.
        ghost: position and rotation of the object once more, where it was planned to be, say.
        axis: unit vector, hand frame; needed where nothing has turned yet.
    """
    links = HandKinematics(hand)(torch.as_tensor(q, dtype=torch.float64))
    pads = {pad.link for pad in hand.pads}
    shapes: list[tuple[Shape | Mesh, Colour]] = []
    transforms: list[Array] = []
    drawn = visuals(hand.urdf).of_link
    for link in hand.urdf.links:
        colour = _TIP if link.name in pads else _PALM if link.name == hand.base_link else _PHALANX
        pose = links.of(link.name).numpy()
        for shape in drawn[link.name]:
            shapes.append((shape, colour))
            transforms.append(pose @ shape.transform)
    solids = () if obj is None else obj.shapes
    for place, colour in (((position, rotation), _OBJECT), (ghost, _GHOST)):
        if solids and place is not None:
            pose = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
            pose[:, :3, 3], pose[:, :3, :3] = place
            shapes += [(shape, colour) for shape in solids]
            transforms += [pose @ shape.transform for shape in solids]
    if not transforms:
        problem = "no link has a <visual> or <collision> that can be drawn"
        raise DescriptionError(hand.urdf_path, problem)
    if axis is None and rotation is not None:
        axis = _axis(np.asarray(rotation))
    ghosts = 0 if ghost is None else len(solids)
    return Scene(shapes, np.stack(transforms, axis=1), *_view(hand, gravity, axis), ghosts=ghosts)


def _axis(rotation: Array) -> Array | None:
    """Of the largest rotation from the first frame; None: nothing has turned. ``rotation``: ``(n, 3, 3)``."""
    turned = log(torch.as_tensor(rotation @ rotation[0].T, dtype=torch.float64)).numpy()
    angles = np.linalg.norm(turned, axis=-1)
    return turned[angles.argmax()] / angles.max() if angles.max() > _TURNED else None


def _view(hand: HandDescription, gravity: Array, axis: Array | None) -> tuple[Array, Array]:
    """Down in the picture, and the side from which it is looked at.

    Along the axis of rotation, or square to a planar hand, from the side of the index finger; where neither
    is known, from there and a little from the front and the palm.
    """
    up = -np.asarray(gravity, dtype=np.float64) / max(float(np.linalg.norm(gravity)), 1e-9)
    usual = np.array([0.35, 1.0 if "left" in hand.name else -1.0, 0.45])
    usual -= 0.5 * (usual @ up) * up
    if hand.planar_normal is not None:
        side = np.array(hand.planar_normal)
    elif axis is not None:
        side = np.array(axis) * (1.0 if axis @ usual >= 0 else -1.0)
    else:
        side = usual
    if np.linalg.norm(np.cross(up, side)) < 1e-6:  # no gravity, or along the line of sight
        return -np.eye(3)[np.argmin(np.abs(side))], side
    return -up, side


def shape_mesh(shape: Shape | Mesh) -> Any:
    """The shape as a ``trimesh.Trimesh`` in its own frame."""
    trimesh = require("trimesh")
    if isinstance(shape, Mesh):
        return trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    if shape.kind == "box":
        return trimesh.creation.box(shape.size)
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=shape.size[0])
    if shape.kind == "cylinder":
        return trimesh.creation.cylinder(shape.size[0], shape.size[1], sections=48)
    mesh = trimesh.creation.capsule(shape.size[1], shape.size[0], count=[24, 24])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))  # centred, whatever the library's convention
    return mesh
