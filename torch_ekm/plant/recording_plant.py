from __future__ import annotations

import dataclasses

import torch

from ..typing import Float, Tensor
from .observation import Observation
from .plant import Plant
from .trajectory import Trajectory
from .wrapper import PlantWrapper


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
        observation = self.plant.command(delta_a)
        self.trajectory.commands.append(torch.as_tensor(delta_a).detach().cpu().double().clone())
        self.trajectory.observations.append(observation)
        return observation
