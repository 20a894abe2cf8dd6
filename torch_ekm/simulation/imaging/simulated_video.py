"""A stream of simulated images, with latency, dropped and hidden frames."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

from ...exceptions import ParameterError
from ...sensing.vision.sources import Frame, StreamOptions
from .card_scene import CardScene
from .simulated_camera import SimulatedCamera


class SimulatedVideo:
    """Frame k shows ``scene_at(k / rate)`` and arrives ``latency`` later, or never.

    It is a function of ``(seed, k)`` and of the scene alone.

    Args:
        camera: draws the images.
        scene_at: the scene at a time [s].
        options: rate, latency, dropped and hidden frames, seed.
        n_frames: length of the stream when iterated over; None: endless.
    """

    def __init__(
        self,
        camera: SimulatedCamera,
        scene_at: Callable[[float], CardScene],
        options: StreamOptions | None = None,
        n_frames: int | None = None,
    ) -> None:
        self.camera, self.scene_at, self.n_frames = camera, scene_at, n_frames
        self.options = options or StreamOptions()

    def frame(self, index: int) -> Frame:
        """Frame number ``index``."""
        if index < 0:
            raise ParameterError("index", index, "zero or positive")
        options, generator = self.options, self.options.generator(index)
        time = index / options.rate
        image = None
        if generator.random() >= options.dropped:
            scene = self.scene_at(time)
            if scene.cards and generator.random() < options.hidden:
                scene = scene.obstructed(int(generator.integers(len(scene.cards))), shade=70)
            image = self.camera.render(scene, generator)
        return Frame(index, time, time + options.latency, image)

    def __iter__(self) -> Iterator[Frame]:
        return map(self.frame, itertools.count() if self.n_frames is None else range(self.n_frames))
