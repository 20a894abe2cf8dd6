"""A stream of simulated images, with latency, dropped and hidden frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ...exceptions import ParameterError
from ...sensing.vision.sources import Frame, StreamOptions
from .card_scene import CardScene
from .simulated_camera import SimulatedCamera


class SimulatedVideo:
    """Frame k shows ``scene_at(k / rate)`` and arrives ``latency`` later, or never.

    A control loop asks for :meth:`latest` and gets what a real one would: the newest frame that has
    arrived, which shows the past. Frames that nobody asks for are not drawn. Frame k is a function of
    ``(seed, k)`` and of the scene alone.

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
        self._next = 0

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

    def latest(self, time: float) -> Frame | None:
        """The newest frame that has arrived by ``time`` [s]; None before the first one.

        Dropped frames never arrive: the one before is the newest, as long as it is.
        """
        options = self.options
        index = int(np.floor((time - options.latency) * options.rate + 1e-9))
        while index >= 0 and options.generator(index).random() < options.dropped:
            index -= 1
        return self.frame(index) if index >= 0 else None

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        if self.n_frames is not None and self._next >= self.n_frames:
            raise StopIteration
        self._next += 1
        return self.frame(self._next - 1)

    def close(self) -> None:
        """Nothing to give back."""
