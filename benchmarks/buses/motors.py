"""What stands behind an emulated bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from torch_ekm.plant import Observation, Plant


class Motors:
    """Motors that go straight to their goals at a constant speed, in the units of a bus.

    Args:
        start: positions.
        speed: of each, per second.
    """

    together = False
    """Off with the last axis of a goal, on a bus that takes one after the other."""

    def __init__(self, start: Sequence[float], speed: float) -> None:
        self.speed = speed
        self._lock = threading.Lock()
        self._from, self.goal, self._at = list(start), list(start), time.monotonic()

    def now(self) -> list[float]:
        """Where the motors are."""
        return self._where(time.monotonic())

    def _where(self, at: float) -> list[float]:
        way = max(0.0, self.speed * (at - self._at))
        pairs = zip(self._from, self.goal, strict=True)
        return [a + min(max(b - a, -way), way) for a, b in pairs]

    @property
    def stands_at(self) -> float:
        """When the last one arrives, or has arrived, of ``time.monotonic()`` [s]."""
        pairs = zip(self._from, self.goal, strict=True)
        return self._at + max(abs(b - a) for a, b in pairs) / self.speed

    @property
    def moving(self) -> bool:
        """Whether one has not arrived."""
        return time.monotonic() < self.stands_at

    def send(self, goal: Sequence[float]) -> None:
        """Off to other goals."""
        with self._lock:
            self._from, self.goal, self._at = self.now(), list(goal), time.monotonic()

    def stop(self, at: float) -> None:
        """Stand where they were at a time of ``time.monotonic()`` [s]."""
        with self._lock:
            here = self._where(at)
            self._from, self.goal, self._at = here, list(here), at


class HandMotors:
    """The motors of a plant, such as a simulated hand, in the units of a bus.

    Goals are carried out by a thread of its own, one after the other, each as one command; meanwhile
    ``moving`` is True and the old positions are shown. A hand comes by all goals, however busy the machine.

    Args:
        plant: with a grasped object.
        bus: (a [rad]) -> positions of the motors.
        value: the inverse of it.
    """

    together = True

    def __init__(
        self,
        plant: Plant,
        bus: Callable[[Sequence[float]], list[float]],
        value: Callable[[Sequence[float]], list[float]],
    ) -> None:
        self.plant, self._bus, self._value = plant, bus, value
        self.seen: Observation = plant.observe()
        """The newest reading of the plant."""
        self._next: list[list[float]] = []
        self._lock = threading.Lock()
        self._worker: Any = None
        self.goal = self.now()

    def now(self) -> list[float]:
        """What the encoders read."""
        return self._bus(self.seen.a.tolist())

    @property
    def moving(self) -> bool:
        """Whether a goal is being carried out."""
        return self._worker is not None

    def reset(self, seed: int) -> None:
        """Another grasp, once the hand stands."""
        while self.moving:
            time.sleep(0.01)
        self.seen = self.plant.reset(seed)
        self.goal = self.now()

    def send(self, goal: Sequence[float]) -> None:
        """Off to other goals."""
        with self._lock:
            self.goal = list(goal)
            self._next.append(self.goal)
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, daemon=True)
                self._worker.start()

    def stop(self, at: float) -> None:
        """Carry out nothing more."""
        with self._lock:
            self._next = []

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._next:
                    self._worker = None
                    return
                goal = self._next.pop(0)
            delta = torch.tensor(self._value(goal), dtype=torch.float64) - self.seen.a
            self.seen = self.plant.command(delta)
