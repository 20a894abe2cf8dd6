"""A quick look at a grasp, in process: what :meth:`InHandRotation.render` shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._extras import require
from ..description import HandDescription, ObjectDescription
from ..description.shape import Shape
from ..kinematics import HandKinematics

Array = NDArray[np.float64]

_HAND, _PAD, _OBJECT = "#c8cacf", "#0072b2", "#e69f00"


class GraspViewer:
    """Collision shapes of hand and object, drawn off screen by PyVista.

    Down in the picture is where gravity pulls; the camera looks along the axis about which a pinch
    turns the object, from the index finger's side.

    Args:
        hand, obj: what is drawn.
        gravity: in the hand frame.
        size: width and height of a picture [pixel].

    Raises:
        MissingExtraError: pyvista is not installed.
    """

    def __init__(
        self,
        hand: HandDescription,
        obj: ObjectDescription,
        gravity: tuple[float, float, float],
        size: tuple[int, int] = (480, 360),
    ) -> None:
        self._pyvista = require("pyvista")
        self._kinematics = HandKinematics(hand)
        self._plotter: Any = self._pyvista.Plotter(off_screen=True, window_size=list(size))
        self._plotter.set_background("white")
        pads = {pad.link for pad in hand.pads}
        self._of_link = [
            (self._kinematics.link_index(link.name), self._add(shape, _PAD if link.name in pads else _HAND))
            for link in hand.urdf.links
            for shape in link.collisions
        ]
        self._of_object = [self._add(shape, _OBJECT) for shape in obj.shapes]
        up = -np.array(gravity) / max(float(np.linalg.norm(gravity)), 1e-9)
        self._up = up if np.linalg.norm(up) > 0 else np.array([0.0, 0.0, 1.0])
        self._side = self._camera_side(hand)

    def picture(self, q: Array, position: Array, rotation: Array) -> NDArray[np.uint8]:
        """The hand at ``q`` [rad] with the object at its pose, ``(height, width, 3)``."""
        links = self._kinematics(torch.from_numpy(q)).transforms.numpy()
        for link, actor in self._of_link:
            actor.user_matrix = links[link]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        for actor in self._of_object:
            actor.user_matrix = pose
        focus = 0.7 * position
        self._plotter.camera_position = [tuple(focus + 0.35 * self._side), tuple(focus), tuple(self._up)]
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(return_img=True), dtype=np.uint8)[..., :3]

    def close(self) -> None:
        """Give back the window."""
        self._plotter.close()

    def _camera_side(self, hand: HandDescription) -> Array:
        if hand.planar_normal is not None:
            return np.array(hand.planar_normal)
        left = -1.0 if "left" in hand.name else 1.0
        side = np.array([0.35, -left, 0.3])
        side -= 0.5 * (side @ self._up) * self._up
        return side / np.linalg.norm(side)

    def _add(self, shape: Shape, colour: str) -> Any:
        mesh = self._mesh(shape)
        mesh.transform(shape.transform, inplace=True)
        return self._plotter.add_mesh(mesh, color=colour, smooth_shading=True, split_sharp_edges=True)

    def _mesh(self, shape: Shape) -> Any:
        pv = self._pyvista
        if shape.kind == "box":
            return pv.Cube(x_length=shape.size[0], y_length=shape.size[1], z_length=shape.size[2])
        if shape.kind == "sphere":
            return pv.Sphere(radius=shape.size[0])
        radius, length = shape.size
        rod = pv.Cylinder(direction=(0, 0, 1), radius=radius, height=length, resolution=48)
        if shape.kind == "cylinder":
            return rod
        caps = [pv.Sphere(radius=radius, center=(0, 0, end * length / 2)) for end in (-1, 1)]
        return (rod.triangulate() + caps[0] + caps[1]).extract_surface(algorithm="dataset_surface")
