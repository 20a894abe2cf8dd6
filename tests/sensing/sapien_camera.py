"""The same picture by SAPIEN's renderer, where there is a Vulkan device."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ekm._extras import require
from torch_ekm.sensing import PinholeCamera
from torch_ekm.simulation import ImageQuality
from torch_ekm.simulation.imaging.card_scene import Card, CardScene, ConvexBody, PlacedCard

# SAPIEN's cameras look along x, with y to the left and z up
_FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


class SapienCamera:
    """An independent renderer with the interface of :class:`SimulatedCamera`: no code is shared.

    Cards are textured rectangles, bodies their hulls; a z-buffer decides what hides what. Drawn twice as
    large and averaged, then blurred and noisy as ``quality`` says. The lens is ideal. A software
    device (Mesa's lavapipe 25 or newer) will do.
    """

    def __init__(self, quality: ImageQuality) -> None:
        self.camera, self.quality = PinholeCamera(), quality
        self._textures: dict[Card, Any] = {}
        sapien = require("sapien")
        sapien.render.set_camera_shader_dir("minimal")
        self._scene = sapien.Scene([sapien.render.RenderSystem()])
        self._scene.set_ambient_light([1.0, 1.0, 1.0])
        k, lens = 2, self.camera
        entity = sapien.Entity()
        self._eye = sapien.render.RenderCameraComponent(k * lens.width, k * lens.height)
        # SAPIEN counts pixels from their corners, OpenCV from their centres
        centre = k * (lens.cx + 0.5), k * (lens.cy + 0.5)
        self._eye.set_perspective_parameters(0.02, 5.0, k * lens.fx, k * lens.fy, *centre, 0.0)
        entity.add_component(self._eye)
        self._scene.add_entity(entity)

    @staticmethod
    def available() -> bool:
        """True where SAPIEN finds a Vulkan device that it supports."""
        try:
            return "Supported: 1" in require("sapien").render.get_device_summary()
        except RuntimeError:
            return False

    def render(self, scene: CardScene, generator: np.random.Generator) -> NDArray[np.uint8]:
        """Picture ``(height, width)`` of the scene; the generator draws its noise."""
        cv2, quality = require("cv2"), self.quality
        drawn = [self._add(*self._card(card)) for card in scene.cards]
        drawn += [self._add(*self._body(body)) for body in scene.bodies]
        self._scene.update_render()
        self._eye.take_picture()
        colour = np.asarray(self._eye.get_picture("Color"), dtype=np.float32)
        for entity in drawn:
            self._scene.remove_entity(entity)
        grey = 255 * np.clip(colour[..., 0], 0, 1)
        if colour.shape[-1] > 3:  # nothing was hit where alpha is 0
            grey = np.where(colour[..., 3] > 0, grey, np.float32(quality.background))
        image = cv2.resize(grey, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
        return quality.spoil(image, generator)

    def _card(self, placed: PlacedCard) -> tuple[NDArray, NDArray, NDArray, Any]:
        """Vertices, triangles, texture coordinates and material; the back is the same card, unprinted."""
        sapien = require("sapien")
        corners = placed.outline  # upper left first, clockwise
        triangles = np.array([[0, 2, 1], [0, 3, 2]] if placed.faces_camera else [[0, 1, 2], [0, 2, 3]])
        uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        material = sapien.render.RenderMaterial()
        if placed.faces_camera:
            material.base_color_texture = self._texture(placed.card)
        else:
            material.base_color = [_linear(0.6 * self.quality.white)] * 3 + [1.0]
        return corners, triangles, uv, material

    def _body(self, body: ConvexBody) -> tuple[NDArray, NDArray, NDArray, Any]:
        points = body.centres
        if np.any(body.radii > 0):
            points = (body.centres[:, None] + body.radii[:, None, None] * _SPHERE).reshape(-1, 3)
        hull = require("scipy.spatial").ConvexHull(points)
        outward = hull.equations[:, :3]
        a, b, c = (points[hull.simplices[:, k]] for k in range(3))
        flip = np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) < 0
        triangles = hull.simplices.copy()
        triangles[flip] = triangles[flip][:, ::-1]
        material = require("sapien").render.RenderMaterial()
        material.base_color = [_linear(body.shade)] * 3 + [1.0]
        return points, triangles, np.zeros((len(points), 2)), material

    def _add(self, points: NDArray, triangles: NDArray, uv: NDArray, material: Any) -> Any:
        sapien = require("sapien")
        vertices = (points @ _FROM_CAMERA.T).astype(np.float32)
        normals = -vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        shape = sapien.render.RenderShapeTriangleMesh(
            vertices, triangles.astype(np.uint32), normals, uv.astype(np.float32), material
        )
        component = sapien.render.RenderBodyComponent()
        component.attach(shape)
        entity = sapien.Entity()
        entity.add_component(component)
        self._scene.add_entity(entity)
        return entity

    def _texture(self, card: Card) -> Any:
        if card not in self._textures:
            quality = self.quality
            print_ = card.texture().astype(np.float32) / 255
            grey = _linear(quality.black + (quality.white - quality.black) * print_)
            rgba = np.dstack([grey, grey, grey, np.ones_like(grey)]).astype(np.float32)
            self._textures[card] = require("sapien").render.RenderTexture2D(
                np.ascontiguousarray(rgba), "R32G32B32A32Sfloat", address_mode="edge"
            )
        return self._textures[card]


def _linear(grey: Any) -> Any:
    """Light of a grey level 0..255: SAPIEN encodes what it draws with a gamma of 2.2."""
    return (grey / 255) ** 2.2


def _fibonacci_sphere(n: int = 200) -> NDArray[np.float64]:
    """Unit vectors ``(n, 3)``, evenly spread."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=-1)


_SPHERE = _fibonacci_sphere()
