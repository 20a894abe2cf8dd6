from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ..kinematics import ActuationMap
from .driver import HandDriver
from .gathered import BusReading
from .wiring import Wiring


class EmulatedPlant(HandDriver):
    """An empty hand without a bus, wired as its file says: a wiring file can be tried before there is a hand.

    Motors go straight to their goals at ``limits.rate``, from where the springs have the hand; joints rest
    where couplings and springs have them, fingertips touch nothing. Packets, messages, ids and what servos
    refuse are not emulated.

    Args:
        wiring: of any driver; the bus is not opened.
        unit: of its motors' positions.
        options: see :class:`HandDriver`.
    """

    def __init__(self, wiring: Wiring, unit: str = HandDriver.unit, **options: Any) -> None:
        super().__init__(wiring, **options)
        self.unit, hand = unit, self.hand
        lower, upper = ([getattr(one, end) for one in wiring.motors] for end in ("lower", "upper"))
        rest = np.clip(hand.spring_rest, hand.joint_lower, hand.joint_upper)
        here = np.clip(hand.unloaded(rest), lower, upper)
        self._from, self._goal, self._sent = here, here, time.monotonic()
        self._map = ActuationMap(hand)
        said = (
            "nothing is connected: motors, joints and pads of an empty hand are emulated in the file's units"
        )
        self.notes.append(
            f"{said}; ids, models, limits and messages of the {wiring.driver} bus are not checked"
        )

    def _read(self) -> BusReading:
        now = time.monotonic()
        way, most = self._goal - self._from, self.limits.rate * (now - self._sent)
        a = self._from + np.clip(way, -most, most)
        q = dict(zip(self.hand.joint_names, self._map.joints(torch.from_numpy(a)).tolist(), strict=True))
        joints = [one.bus(q[one.name]) for one in self.wiring.joints]
        taken = now if joints else math.inf
        tips = [one.bus(0.0) for one in self.wiring.fingertips]
        moving = bool(np.abs(way).max() > most)
        return BusReading(self._bus(a), now, moving, joints, taken, tips, now if tips else math.inf)

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        now = self._a(self._read()).numpy()
        self._from, self._goal, self._sent = (
            now,
            self._values(self.wiring.motors, goal).numpy(),
            time.monotonic(),
        )

    def _release(self) -> None:
        return
