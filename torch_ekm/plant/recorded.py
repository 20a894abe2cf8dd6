"""Plants that write down what passes, and play it again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from ..exceptions import StateError
from ..typing import Float, Tensor
from .observation import Observation
from .plant import Path, Plant, PlantWrapper, can_follow
from .trajectory import Movement, Trajectory


class RecordingPlant(PlantWrapper):
    """Passes everything on to a plant and remembers it in ``trajectory``, which outlives the plant.

    With a :class:`~torch_ekm.plant.TrialLog` each trial is kept::

        log = TrialLog("log", configuration)
        for trial in log.missing(range(1000)):
            plant.reset(trial)
            ...
            log.write(trial, plant.trajectory)
    """

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.trajectory = Trajectory()

    def reset(self, seed: int) -> Observation:
        """Grasp again, and start a new trajectory, which stays empty if there is no grasp."""
        self.trajectory = Trajectory(seed)
        observation = self.plant.reset(seed)
        self.trajectory.observations.append(observation)
        return observation

    def observe(self) -> Observation:
        """Read the sensors; recorded in the place of the last reading, since the hand has not moved."""
        observation = self.plant.observe()
        known = self.trajectory.observations
        before = known[-1].info if known else {}  # a plant may have held the object before it was recorded
        if "events" in before:
            info = {**observation.info, "events": before["events"]}
            observation = dataclasses.replace(observation, info=info)
        known[-1:] = [observation]
        return observation

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Pass the increment [rad] on; it and the observation after it are recorded."""
        if not self.trajectory.observations:
            self.observe()
        return self._kept(delta_a, self.plant.command(delta_a))

    def _followed(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """Pass the path on; it, the readings on the way and the observation after it are recorded."""
        if not self.trajectory.observations:
            self.observe()
        assert can_follow(self.plant)
        passed: list[Observation] = []
        observation = self.plant.follow(path, lambda seen: passed.append(seen) or watch(seen))
        self.trajectory.movements[len(self.trajectory.commands)] = Movement(path, passed)
        return self._kept(path.waypoints[-1], observation)

    def _kept(self, delta_a: Float[Tensor, " n_a"], observation: Observation) -> Observation:
        self.trajectory.commands.append(torch.as_tensor(delta_a).detach().cpu().double().clone())
        self.trajectory.observations.append(observation)
        return observation


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
