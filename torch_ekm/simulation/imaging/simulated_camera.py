"""The picture that a camera would take of cards and fingers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import ParameterError
from ...sensing.camera import PinholeCamera
from .card_scene import CardScene, ConvexBody, PlacedCard

_SAMPLES = 4  # of a card, per pixel and direction
_SHIFT = 4  # fractional bits of OpenCV's polygon coordinates
_EDGE_ON = 1e-6  # cosine below which a card shows nothing of its face
_BLUR = 0.7  # [px] standard deviation of lens and focus blur
_NOISE = 3.0  # [grey levels of 255] standard deviation of each pixel
_BLACK, _WHITE, _BACKGROUND = 30.0, 220.0, 110.0  # grey levels of print and paper in full light, and around
_VIGNETTE = 0.15  # share of the light that the corners of the image lose


class SimulatedCamera:
    """Draws cards by their homography ``x ~ K [r1 r2 t] X``, then bodies, blur and noise.

    Cards are sampled 16 times in each pixel and hidden by the bodies before them and
    by nearer cards; the scene has the true poses, a tracker gets the picture alone.

    Args:
        camera: the lens, without distortion.

    Raises:
        ParameterError: a lens that distorts.
    """

    def __init__(self, camera: PinholeCamera | None = None) -> None:
        self.camera = camera or PinholeCamera()
        if any(self.camera.distortion):
            raise ParameterError(
                "camera.distortion", self.camera.distortion, "0: straight lines are drawn straight"
            )
        v, u = np.mgrid[: self.camera.height, : self.camera.width].astype(np.float32)
        radius2 = (u - self.camera.cx) ** 2 + (v - self.camera.cy) ** 2
        self._light = 1 - _VIGNETTE * radius2 / radius2.max()

    def render(self, scene: CardScene, generator: np.random.Generator) -> NDArray[np.uint8]:
        """Picture ``(height, width)`` of the scene; the generator draws its noise."""
        cv2 = require("cv2")
        drawn = np.full((self.camera.height, self.camera.width), _BACKGROUND, dtype=np.uint8)
        # an outline is needed up to three times: for its body, and for each card that it may hide
        bodies = [(body, body.outline(self.camera)) for body in scene.bodies]
        for body, outline in sorted(bodies, key=lambda item: -item[0].centres[:, 2].mean()):
            if outline is not None:
                fixed = np.rint(outline * 2**_SHIFT).astype(np.int32)
                cv2.fillConvexPoly(drawn, fixed, body.shade, cv2.LINE_AA, _SHIFT)
        image = drawn.astype(np.float32)
        for card in sorted(scene.cards, key=lambda c: -c.pose[2, 3]):
            self._draw_card(image, card, bodies)
        image *= self._light
        if _BLUR > 0:
            image = cv2.GaussianBlur(image, (0, 0), _BLUR)
        image = image + _NOISE * generator.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def _draw_card(
        self, image: NDArray, placed: PlacedCard, bodies: list[tuple[ConvexBody, NDArray | None]]
    ) -> None:
        cv2, s, camera = require("cv2"), _SAMPLES, self.camera
        outline = placed.outline
        away = placed.pose[:3, 2] @ placed.pose[:3, 3]  # n . c: below 0 its printed side can be seen
        cosine = abs(away) / np.linalg.norm(placed.pose[:3, 3])
        if np.any(outline[:, 2] < 1e-3) or cosine < _EDGE_ON:
            return
        corners = self.camera.project(outline)
        if not np.all(np.abs(corners) < 1e5):
            return
        u0, v0 = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
        u1, v1 = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, image.shape[::-1])
        if u0 >= u1 or v0 >= v1:
            return
        u0, v0, u1, v1 = int(u0), int(v0), int(u1), int(v1)  # numpy's would make the samples float64
        u = u0 - 0.5 + (np.arange((u1 - u0) * s, dtype=np.float32) + 0.5) / s
        v = v0 - 0.5 + (np.arange((v1 - v0) * s, dtype=np.float32) + 0.5) / s
        x, y = (u - camera.cx) / camera.fx, ((v - camera.cy) / camera.fy)[:, None]  # x/z, y/z of the samples
        # plane of the card: (x, y, 1) ~ [r1 r2 t] (X, Y, 1)
        to_card = np.linalg.inv(placed.pose[:3, [0, 1, 3]]).astype(np.float32)
        X, Y, W = (row[0] * x + row[1] * y + row[2] for row in to_card)
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray along the card does not meet it
            X, Y = X / W, Y / W
        width, height = placed.card.size
        inside = (np.abs(X) <= width / 2) & (np.abs(Y) <= height / 2)
        visible = inside.astype(np.float32)
        for body, polygon in bodies:
            if polygon is not None and placed.hidden_by(body):
                fine = (polygon - [u0, v0] + 0.5) * s - 0.5  # centres of pixels and of samples
                cv2.fillConvexPoly(
                    visible, np.rint(fine * 2**_SHIFT).astype(np.int32), 0.0, cv2.LINE_8, _SHIFT
                )
        light = 0.7 + 0.3 * cosine
        if away < 0:
            texture = placed.card.texture
            n_y, n_x = texture.shape
            tx = (X / width + 0.5) * n_x - 0.5
            ty = (0.5 - Y / height) * n_y - 0.5
            print_ = cv2.remap(texture, tx, ty, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            value = _BLACK + (_WHITE - _BLACK) / 255 * print_
        else:
            value = np.full_like(visible, 0.6 * _WHITE)  # the bare back
        size = (u1 - u0, v1 - v0)
        alpha = cv2.resize(visible, size, interpolation=cv2.INTER_AREA)
        colour = cv2.resize(value * (light * visible), size, interpolation=cv2.INTER_AREA)
        patch = image[v0:v1, u0:u1]
        patch *= 1 - alpha
        patch += colour
