"""A plant that takes notes."""

from __future__ import annotations

import dataclasses

import torch

from ..typing import Float, Tensor
from .observation import Observation
from .plant import Plant
from .trajectory import Recording
from .wrapper import PlantWrapper


class RecordingPlant(PlantWrapper):
    """Passes everything on to a plant and remembers it in ``recording``, which outlives the plant.

    With a :class:`~torch_ekm.plant.TrialLog` each trial is kept::

        log = TrialLog("log", configuration)
        for trial in log.missing(range(1000)):
            plant.reset(trial)
            ...
            log.write(trial, plant.recording)
    """

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.recording = Recording()

    def reset(self, seed: int) -> Observation:
        """Grasp anew, and start a new recording, which stays empty if there is no grasp."""
        self.recording = Recording(seed)
        observation = self.plant.reset(seed)
        self.recording.observations.append(observation)
        return observation

    def observe(self) -> Observation:
        """Read the sensors; recorded in the place of the last reading, since the hand has not moved."""
        observation = self.plant.observe()
        if self.recording.observations:
            before = self.recording.observations[-1].info
            kept = {name: before[name] for name in ("events",) if name in before}
            observation = dataclasses.replace(observation, info={**observation.info, **kept})
            self.recording.observations[-1] = observation
        return observation

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Pass the command on."""
        observation = self.plant.command(delta_a)
        self.recording.commands.append(torch.as_tensor(delta_a).detach().cpu().double().clone())
        self.recording.observations.append(observation)
        return observation
