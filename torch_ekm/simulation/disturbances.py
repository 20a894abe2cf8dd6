"""Things that happen in the middle of a run: a tendon is replaced, somebody tugs at the object."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..exceptions import ParameterError
from ..plant.plant import Observation
from ..typing import Float, Tensor
from .simulated_hand import SimulatedHand


@dataclass(frozen=True)
class Change:
    """Before command number ``at`` (from 0): plant parameters take new values, and keep them."""

    at: int
    changes: Mapping[str, Any]

    def happen(self, plant: SimulatedHand) -> None:
        plant.change(**self.changes)

    @classmethod
    def new_tendons(cls, at: int, moment_arm: float | tuple[float, ...]) -> Change:
        """All tendons replaced: other moment arms, and no elongation yet."""
        return cls(at, {"moment_arm": moment_arm, "tendon_elongation": 0.0})


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
        plant.tug(np.array(self.force), np.array(self.torque), self.duration)


@dataclass
class DisturbedPlant:
    """A simulated hand to which things happen at given commands; implements :class:`Plant`.

    Commands are counted from construction on, across resets, since a worn tendon stays worn.
    Each observation names what happened just before it in ``info["events"]``.

    Raises:
        ParameterError: an event lies before the first command.
    """

    plant: SimulatedHand
    events: Iterable[Change | Tug] = ()
    count: int = field(default=0, init=False)
    """Commands given so far."""

    def __post_init__(self) -> None:
        self.events = tuple(sorted(self.events, key=lambda event: event.at))
        for event in self.events:
            if event.at < 0:
                raise ParameterError("event.at", event.at, "0 or more")

    def reset(self, seed: int) -> Observation:
        """Grasp the object anew."""
        return self.plant.reset(seed)

    def observe(self) -> Observation:
        """Read the sensors."""
        return self.plant.observe()

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Let happen what is due, then move the actuators by ``delta_a`` [rad] and read the sensors."""
        due = [event for event in self.events if event.at == self.count]
        for event in due:
            event.happen(self.plant)
        self.count += 1
        observation = self.plant.command(delta_a)
        if due:
            observation.info["events"] = tuple(due)
        return observation

    def close(self) -> None:
        """Give back what the plant holds."""
        self.plant.close()
