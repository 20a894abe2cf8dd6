"""Pictures through a lens that distorts: the simulated camera's is ideal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torch_ekm.sensing import PinholeCamera
from torch_ekm.simulation import SimulatedCamera

cv2 = pytest.importorskip("cv2")


def rays(lens: PinholeCamera, pixels: np.ndarray) -> np.ndarray:
    """Inverse of ``lens.project``: ``(x/z, y/z)`` of pixels, ``(*batch, 2)``."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float64)
    found = cv2.undistortPoints(flat, lens.matrix, lens.distortion_array, criteria=criteria)
    return found.reshape(pixels.shape)


def render(lens: PinholeCamera, scene, rng) -> np.ndarray:
    """The picture of an ideal lens, each pixel taken from where its ray meets it."""
    ideal = replace(lens, distortion=(0.0,) * 5)
    image = SimulatedCamera(ideal).render(scene, rng)
    if not any(lens.distortion):
        return image
    v, u = np.mgrid[: lens.height, : lens.width]
    at = rays(lens, np.stack([u, v], axis=-1)) * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    return cv2.remap(image, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
