"""Images with their times. A source of them is an ``Iterable[Frame]``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...exceptions import ParameterError


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a stream."""

    index: int
    """Number in the stream, counted from 0; dropped frames count."""
    time: float
    """When it was exposed [s]."""
    arrival: float
    """When it can be used [s]: ``time`` plus the latency."""
    image: NDArray[np.uint8] | None
    """Grey ``(h, w)`` or BGR ``(h, w, 3)``; None: the frame was dropped."""


@dataclass(frozen=True)
class StreamOptions:
    """How images come in; the defaults are a VGA camera of 20 Hz (section III.C of the paper) on USB.

    Raises:
        ParameterError: a value is out of range.
    """

    rate: float = 20.0
    """[Hz]"""
    latency: float = 0.05
    """Time between exposure and use [s]."""
    dropped: float = 0.0
    """Probability that a frame never arrives."""
    hidden: float = 0.0
    """Probability that something passes between the camera and one of the cards."""
    seed: int = 0
    """Of the dropped and hidden frames and of the pixel noise."""

    def __post_init__(self) -> None:
        if not self.rate > 0:
            raise ParameterError("StreamOptions.rate", self.rate, "positive [Hz]")
        if not self.latency >= 0:
            raise ParameterError("StreamOptions.latency", self.latency, "zero or positive [s]")
        for name in ("dropped", "hidden"):
            if not 0 <= getattr(self, name) < 1:
                raise ParameterError(f"StreamOptions.{name}", getattr(self, name), "within [0, 1)")

    def generator(self, index: int) -> np.random.Generator:
        """Randomness of one frame: the same whatever frames were looked at before."""
        return np.random.default_rng([self.seed, index])
