"""What stands behind an emulated bus: motors alone, or the motors of a hand."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from ..plant import Observation, Plant


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


class HandMotors:
    """The motors of a plant, such as a simulated hand, in the units of a bus.

    A goal is carried out by a thread of its own, as one command; while it runs, ``moving`` is True and the
    old positions are shown. A goal that comes meanwhile is carried out next.

    Args:
        plant: with a grasped object.
        bus: (a [rad]) -> positions of the motors.
        value: the inverse of it.
    """

    def __init__(
        self,
        plant: Plant,
        bus: Callable[[Sequence[float]], list[float]],
        value: Callable[[Sequence[float]], list[float]],
    ) -> None:
        self.plant, self._bus, self._value = plant, bus, value
        self.seen: Observation = plant.observe()
        """The newest reading of the plant."""
        self._next: list[float] | None = None
        self._lock = threading.Lock()
        self._worker: Any = None

    def now(self) -> list[float]:
        """What the encoders read."""
        return self._bus(self.seen.a.tolist())

    @property
    def moving(self) -> bool:
        """Whether a goal is being carried out."""
        return self._worker is not None

    def send(self, goal: Sequence[float]) -> None:
        """Off to other goals."""
        with self._lock:
            self._next = list(goal)
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, daemon=True)
                self._worker.start()

    def stop(self) -> None:
        """Carry out nothing more."""
        with self._lock:
            self._next = None

    def _work(self) -> None:
        while True:
            with self._lock:
                goal, self._next = self._next, None
                if goal is None:
                    self._worker = None
                    return
            delta = torch.tensor(self._value(goal), dtype=torch.float64) - self.seen.a
            self.seen = self.plant.command(delta)
