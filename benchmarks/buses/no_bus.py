"""A driver of motors in its own process: what the base of the drivers does by itself."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from motors import Motors

from torch_ekm.drivers import BusReading, HandDriver, Wiring


class FakeDriver(HandDriver):
    """A bus that is a list of motors; ``spoil`` changes what it reads.

    Args:
        path: a wiring file for two Dynamixel servos; here they have 600 ticks a rad.
        speed: of the motors [ticks/s].
        options: see :class:`HandDriver`.
    """

    def __init__(self, path: Path, speed: float = 4000.0, **options: Any) -> None:
        super().__init__(Wiring.read(path, "dynamixel", 600.0, ("port", "baud")), **options)
        self.motors = Motors([1600.0, 2400.0], speed)
        self.written: list[tuple[list[float], float]] = []
        self.spoil: Callable[[BusReading], BusReading] = lambda reading: reading
        self.released = False

    def _read(self) -> BusReading:
        return self.spoil(BusReading(self.motors.now(), time.monotonic(), moving=self.motors.moving))

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        self.written.append((list(goal), seconds))
        self.motors.send(goal)

    def _release(self) -> None:
        self.released = True
