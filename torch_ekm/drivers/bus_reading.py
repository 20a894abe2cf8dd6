from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class BusReading:
    """What a bus says, in its own units, in the order of the wiring; times of ``time.monotonic()`` [s]."""

    motors: Sequence[float]
    taken: float
    """When the motors were read."""
    moving: bool = False
    """The bus reports that a motor moves; False: it does not, or does not report it."""
    joints: Sequence[float] = ()
    joints_taken: float = math.inf
    fingertips: Sequence[float] = ()
    fingertips_taken: float = math.inf
    load: Sequence[float] = ()
    """Current or torque of each motor, for ``Observation.info`` [unit of the bus]."""
    oldest: str = ""
    """Which motor's reading is the oldest, where they come one by one: for errors."""
