from __future__ import annotations

from collections.abc import Callable

from ..exceptions import StateError
from ..typing import Float, Tensor
from .observation import Observation
from .path import Path
from .trajectory import Trajectory


class ReplayedPlant:
    """Gives the recorded observations one by one, independent of the commands; implements :class:`Plant`.

    A driver of a real hand has the same methods: send the increment, wait until it is done, read the sensors.

    Raises:
        StateError: the trajectory is empty.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if not trajectory.observations:
            raise StateError("the trajectory is empty: it has no observation to begin with")
        self.trajectory = trajectory
        self._place = 0

    def reset(self, seed: int = 0) -> Observation:
        """Back to the first observation; the seed plays no part."""
        self._place = 0
        return self.observe()

    def observe(self) -> Observation:
        """The recorded observation after the last replayed command."""
        return self.trajectory.observations[self._place]

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """The next observation.

        Raises:
            StateError: the trajectory ends here.
        """
        if self._place >= len(self.trajectory.commands):
            raise StateError(f"the recording ends after {self._place} commands; reset() begins again")
        self._place += 1
        return self.observe()

    def follow(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """The next observation, after the recorded readings on the way, if it was a movement.

        Raises:
            StateError: the trajectory ends here.
        """
        movement = self.trajectory.movements.get(self._place)
        after = self.command(path.waypoints[-1])
        for seen in movement.passed if movement else ():
            if not watch(seen):
                break
        return after

    def close(self) -> None:
        """Does nothing: a recording holds no device."""
