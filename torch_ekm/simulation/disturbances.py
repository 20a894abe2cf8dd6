"""Things that happen in the middle of a run: a tendon is replaced, the object is tugged at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..exceptions import ParameterError
from ..plant import Observation, Path, PlantWrapper
from ..typing import Float, Tensor
from .simulated_hand import SimulatedHand


@dataclass(frozen=True)
class PlantChange:
    """Before command number ``at`` (from 0): plant parameters take new values, and keep them."""

    at: int
    changes: Mapping[str, Any]

    def happen(self, plant: SimulatedHand) -> None:
        """Give ``plant`` the new parameters, now."""
        plant.change(**self.changes)


@dataclass(frozen=True)
class Tug:
    """Before command number ``at`` (from 0): a pull [N] and a twist [N m] at the object, hand frame.

    The box of the iCub's pinch of 5 N stays at 3 N along z, slips by about 10 deg at 5 N, and is
    torn out at 12 N (50 ms).
    """

    at: int
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    duration: float = 0.05
    """[s]"""

    def happen(self, plant: SimulatedHand) -> None:
        """Tug at the object that ``plant`` holds, now."""
        plant.tug(np.array(self.force), np.array(self.torque), self.duration)


class DisturbedPlant(PlantWrapper):
    """A simulated hand to which things happen at given commands.

    Commands are counted from construction on, across resets, since a worn tendon stays worn.
    Each observation names what happened just before it in ``info["events"]``.

    Raises:
        ParameterError: an event lies before the first command.
    """

    plant: SimulatedHand

    def __init__(self, plant: SimulatedHand, events: Iterable[PlantChange | Tug] = ()) -> None:
        super().__init__(plant)
        self.events = tuple(sorted(events, key=lambda event: event.at))
        self.count = 0
        """Commands given so far."""
        for event in self.events:
            if event.at < 0:
                raise ParameterError("event.at", event.at, "0 or more")

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Let happen what is due, then move the actuators by ``delta_a`` [rad] and read the sensors."""
        return self._after_events(lambda: self.plant.command(delta_a))

    def _followed(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """The same before a movement, which counts as one command."""
        return self._after_events(lambda: self.plant.follow(path, watch))

    def _after_events(self, move: Callable[[], Observation]) -> Observation:
        due = tuple(event for event in self.events if event.at == self.count)
        for event in due:
            event.happen(self.plant)
        self.count += 1
        observation = move()
        if due:
            observation.info["events"] = due
        return observation
