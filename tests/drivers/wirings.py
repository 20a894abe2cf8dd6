"""Wiring files for tests, and a bus with nothing behind it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from motors import Motors

from torch_ekm.drivers import BusReading, HandDriver, Wiring

T42 = """\
[hand]
driver = "dynamixel"
description = "yale_t42"

[bus]
port = "PORT"
baud = 1000000

[[motors]]
name = "right"
id = 2
sign = -1
zero = 3000

[[motors]]
name = "left"
id = 1
zero = 1000

[limits]
increment_deg = 20
rate_deg = 200
still_for = 0.05
timeout = 0.5
"""


def write(folder: Path, text: str = T42, port: str = "none", **changes: str) -> Path:
    """A wiring file; ``changes`` of its text, one after the other: ``a="old|new"``."""
    for change in changes.values():
        old, new = change.split("|")
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "my_hand.toml"
    path.write_text(text.replace("PORT", port))
    return path


class FakeDriver(HandDriver):
    """A bus that is a list of motors; ``spoil`` changes what it reads."""

    def __init__(self, path: Path, **options) -> None:
        super().__init__(Wiring.read(path, "dynamixel", 600.0, ("port", "baud")), **options)
        self.motors = Motors([1600.0, 2400.0], 4000.0)
        self.written: list[tuple[list[float], float]] = []
        self.spoil = lambda reading: reading
        self.released = False

    def _read(self) -> BusReading:
        return self.spoil(BusReading(self.motors.now(), time.monotonic(), moving=self.motors.moving))

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        self.written.append((list(goal), seconds))
        self.motors.send(goal)

    def _release(self) -> None:
        self.released = True
