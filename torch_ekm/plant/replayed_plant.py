from __future__ import annotations

from ..exceptions import ParameterError
from ..typing import Float, Tensor
from .observation import Observation
from .trajectory import Trajectory


class ReplayedPlant:
    """Gives the recorded observations one by one, independent of the commands; implements :class:`Plant`.

    A driver of a real hand has the same methods: send the increment, wait until it is done, read the sensors.

    Raises:
        ParameterError: the trajectory is empty.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if not trajectory.observations:
            raise ParameterError("trajectory", "empty", "one with at least one observation")
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
            ParameterError: the trajectory ends here.
        """
        if self._place >= len(self.trajectory.commands):
            valid = f"at most {len(self.trajectory.commands)}: the recording ends there"
            raise ParameterError("command", self._place + 1, valid)
        self._place += 1
        return self.observe()

    def close(self) -> None:
        """Does nothing: a recording holds no device."""
