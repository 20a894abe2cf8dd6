"""The pose of something that stands still, from many noisy looks at it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..._extras import require
from .board_pose import BoardPose


class StaticPose:
    """``x <- x + (z - x) / m``, ``P = S / m`` with ``m = min(k, frames)`` at the k-th look ``z``.

    Means and differences are taken on the twist ``(z_t - x_t; Log(R_z R_x^T))``. ``frames`` bounds the
    weight of the past, since the errors of successive looks share a part that no average removes.
    Three looks in a row beyond ``chi^2 = 22.46`` (one in a thousand for six degrees of freedom) say
    that the thing has moved: start again. A single one is ignored.

    Args:
        frames: looks that are averaged; 1 gives each look back unchanged, and None for a missing one.
    """

    _GATE, _PATIENCE = 22.46, 3

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self._mean: BoardPose | None = None
        self._looks = self._outside = 0

    def update(self, look: BoardPose | None) -> BoardPose | None:
        """The best estimate after this look; None if nothing was ever seen."""
        if self.frames == 1 or look is None:
            return look if self.frames == 1 else self._mean
        if self._mean is None:
            return self._restart(look)
        cv2, mean, S = require("cv2"), self._mean, look.covariance
        turn = cv2.Rodrigues(look.rotation @ mean.rotation.T)[0].ravel()
        innovation = np.concatenate([look.position - mean.position, turn])
        if innovation @ np.linalg.solve(mean.covariance + S, innovation) > self._GATE:
            self._outside += 1
            return self._restart(look) if self._outside >= self._PATIENCE else mean
        self._outside, self._looks = 0, min(self._looks + 1, self.frames)
        step = innovation / self._looks
        self._mean = replace(
            look,
            rotation=cv2.Rodrigues(step[3:])[0] @ mean.rotation,
            position=mean.position + step[:3],
            covariance=S / self._looks,
        )
        return self._mean

    def _restart(self, look: BoardPose) -> BoardPose:
        self._mean, self._looks, self._outside = look, 1, 0
        return look
