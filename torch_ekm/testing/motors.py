"""What stands behind an emulated bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence


class Motors:
    """Motors that go straight to their goals at a constant speed, in the units of a bus.

    Args:
        start: positions.
        speed: of each, per second.
    """

    def __init__(self, start: Sequence[float], speed: float) -> None:
        self.speed = speed
        self._lock = threading.Lock()
        self._from, self._goal, self._at = list(start), list(start), time.monotonic()

    def now(self) -> list[float]:
        """Where the motors are."""
        way = self.speed * (time.monotonic() - self._at)
        pairs = zip(self._from, self._goal, strict=True)
        return [a + min(max(b - a, -way), way) for a, b in pairs]

    @property
    def moving(self) -> bool:
        """Whether one has not arrived."""
        return self.now() != self._goal

    def send(self, goal: Sequence[float]) -> None:
        """Off to other goals."""
        with self._lock:
            self._from, self._goal, self._at = self.now(), list(goal), time.monotonic()

    def stop(self) -> None:
        """Stand here."""
        self.send(self.now())
