from __future__ import annotations

import math
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..exceptions import BusError


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


_SAME = 0.5  # [s] messages that are later from the first one on come from a clock that is behind
_DRIFT = 2e-4  # that clocks part from each other
_ALIVE = 0.5  # [s] of a publisher since its last message
_NAMELESS = "messages without names"


class Value(NamedTuple):
    """A number, and whose it is; times of ``time.monotonic()`` [s]."""

    number: float
    taken: float
    publisher: Hashable


class SenderClock:
    """How far a sender's clock is off ours: by the least that a message was ever late, less their drift.

    What all messages have in common, their latency or the clocks' difference, cannot be distinguished: up to
    0.5 s it counts as latency, more and what is negative as difference.
    """

    def __init__(self) -> None:
        self._least, self._at = math.inf, 0.0

    def taken(self, late: float | None, arrived: float) -> float:
        """When a message was sent that arrives so much after its stamp [s]; None: it has no stamp."""
        if late is None:
            return arrived
        self._least = min(late, self._least + _DRIFT * (arrived - self._at))
        self._at = arrived
        return arrived - max(0.0, late - self.behind)

    @property
    def behind(self) -> float:
        """That the sender's clock is behind ours [s]; 0: within their latency."""
        return self._least if math.isfinite(self._least) and not 0 <= self._least <= _SAME else 0.0


class Gathered:
    """The newest values by name, whoever sends them: a hand beside an arm, a node for each motor.

    Args:
        topic: where they come from, for errors.
        wanted: names that matter; all others may say what they want.
        called: what a publisher is called in errors.
    """

    def __init__(self, topic: str, wanted: Sequence[str], called: Callable[[Hashable], str] = str) -> None:
        self.topic, self.wanted, self.called = topic, frozenset(wanted), called
        self.clocks: dict[Hashable, SenderClock] = {}
        """Of each publisher."""
        self.heard: dict[str, float] = {}
        """When each name was last heard."""
        self._values: dict[tuple[str, str], dict[Hashable, Value]] = {}
        self._wrong: dict[Hashable, tuple[str, float]] = {}
        self._lock = threading.Lock()

    def take(
        self,
        names: Sequence[str],
        parts: Mapping[str, Sequence[float]],
        publisher: Hashable,
        late: float | None,
        arrived: float,
    ) -> None:
        """A message: of each part as many numbers as names, or none; those of the first one are finite."""
        with self._lock:
            taken = self.clocks.setdefault(publisher, SenderClock()).taken(late, arrived)
            self.heard.update(dict.fromkeys(names or [_NAMELESS], arrived))
            mine = [name for name in names if name in self.wanted]
            if not mine:
                return
            self._wrong.pop(publisher, None)
            if wrong := self._contradiction(names, parts):
                self._wrong[publisher] = wrong, arrived
                return
            for part, numbers in parts.items():
                for name, number in zip(names, numbers, strict=False):
                    if name in self.wanted:
                        by = self._values.setdefault((part, name), {})
                        if publisher not in by or by[publisher].taken <= taken:  # else one overtook it
                            by[publisher] = Value(float(number), taken, publisher)

    def _contradiction(self, names: Sequence[str], parts: Mapping[str, Sequence[float]]) -> str:
        """What is wrong with a message; "": nothing."""
        if twice := [name for name in dict.fromkeys(names) if name in self.wanted and names.count(name) > 1]:
            return f"the name '{', '.join(twice)}' twice in one message"
        if uneven := [f"{len(x)} {part}s" for part, x in parts.items() if len(x) not in (0, len(names))]:
            return f"{len(names)} names and {', '.join(uneven)}"
        part, numbers = next(iter(parts.items()))
        for name, number in zip(names, numbers, strict=False):
            if name in self.wanted and not math.isfinite(number):
                return f"a {part} of '{name}' that is NaN or infinite"
        return ""

    def newest(self, part: str, names: Sequence[str], now: float) -> list[Value | None]:
        """Of each name; None: nobody has sent it.

        Raises:
            BusError: a publisher contradicts itself, or two of them send the same quantity.
        """
        with self._lock:
            wrong = [(of, text) for of, (text, arrived) in self._wrong.items() if now - arrived < _ALIVE]
            found = [
                sorted(self._values.get((part, name), {}).values(), key=lambda one: one.taken)
                for name in names
            ]
        for publisher, text in wrong:
            raise BusError(self.topic, f"{self.called(publisher)} sends {text}")
        for name, values in zip(names, found, strict=True):
            alive = [one.publisher for one in values if now - one.taken < _ALIVE]
            if len(alive) > 1:
                both = " and ".join(map(self.called, alive))
                problem = f"{both} send the {part} of '{name}': one of them must be silent"
                raise BusError(self.topic, problem)
        return [values[-1] if values else None for values in found]

    def absent(self, part: str, names: Sequence[str]) -> str:
        """Which of these nobody sends, and what is sent instead."""
        missing = ", ".join(f"'{name}'" for name in names if (part, name) not in self._values)
        if not self.heard:
            return "nothing is received"
        return f"has no {part} of {missing}; it has: {', '.join(self.heard)}"
