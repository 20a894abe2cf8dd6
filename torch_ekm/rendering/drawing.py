"""Meshes drawn off screen by PyVista.

Run as a file it draws one picture in a process of its own, and imports nothing of the package: half of the
time of a small picture would be the import of torch.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Vertices ``(n, 3)`` [m], faces ``(m, 3)``, colour, opacity.
Drawn = tuple[NDArray[np.float64], NDArray[np.int64], tuple[float, float, float], float]
#: Position and focus [m], and up.
Camera = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class Picture:
    """Frames side by side, drawn off screen by PyVista as often as they change.

    Args:
        meshes: the same in each frame; :attr:`Scene.meshes`.
        frames: their number.
        size: width and height of one frame [pixel].
        smooth: without jagged edges; takes longer.
    """

    def __init__(
        self,
        meshes: Sequence[Drawn],
        frames: int = 1,
        size: tuple[int, int] = (480, 360),
        smooth: bool = False,
    ) -> None:
        import pyvista

        self._plotter: Any = pyvista.Plotter(
            off_screen=True, shape=(1, frames), border=False, window_size=[frames * size[0], size[1]]
        )
        made = [(pyvista.PolyData.from_regular_faces(v, f), c, o) for v, f, c, o in meshes]
        look = {"smooth_shading": True, "split_sharp_edges": True, "specular": 0.3, "specular_power": 15}
        self._actors = []
        for k in range(frames):
            self._plotter.subplot(0, k)
            self._plotter.set_background("white")
            self._actors.append([self._plotter.add_mesh(m, color=c, opacity=o, **look) for m, c, o in made])
            if smooth:
                self._plotter.enable_anti_aliasing("ssaa")

    def draw(
        self, transforms: NDArray[np.float64], camera: Camera, path: Path | None = None
    ) -> NDArray[np.uint8]:
        """The picture ``(height, width, 3)``, also written to ``path``.

        Args:
            transforms: ``(n_frames, n_meshes, 4, 4)``.
            camera: of all frames.
        """
        for k, actors in enumerate(self._actors):
            self._plotter.subplot(0, k)
            for actor, transform in zip(actors, transforms[k], strict=True):
                actor.user_matrix = transform
            self._plotter.camera_position = [tuple(part) for part in camera]
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(path, return_img=True), dtype=np.uint8)[..., :3]

    def close(self) -> None:
        """Close the off-screen window and release its memory."""
        self._plotter.close()


if __name__ == "__main__":
    meshes, transforms, camera, path, size = pickle.load(sys.stdin.buffer)
    Picture(meshes, len(transforms), size, smooth=True).draw(transforms, camera, path)
