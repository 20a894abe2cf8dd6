"""Messages that are garbled, cut, doubled or late."""

from __future__ import annotations

import random


class Spoiler:
    """Bytes of a message -> what arrives of it, drawn from a seed.

    Args:
        chance: that a message is spoilt, 0 to 1.
        seed: of the draws.
    """

    def __init__(self, chance: float, seed: int) -> None:
        self.chance = chance
        self.count = 0
        """Messages that were spoilt."""
        self._draw, self._last = random.Random(seed), b""

    def __call__(self, data: bytes) -> bytes:
        draw = self._draw
        if not data or draw.random() > self.chance:
            return data
        self.count += 1
        last, self._last = self._last, data
        place = draw.randrange(len(data))
        return (
            data[:place] + bytes([draw.randrange(256)]) + data[place + 1 :],  # garbled
            data[:place],  # cut
            data + data,  # doubled
            last,  # late: instead of this one
            last + data,  # late: in front of this one
        )[draw.randrange(5)]
