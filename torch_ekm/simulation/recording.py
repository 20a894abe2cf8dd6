"""A plant that replays what another one did: an example of a driver."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from .._extras import require
from ..exceptions import DescriptionError, ParameterError
from ..typing import Float, Tensor
from .plant import Observation, Plant, PlantStatus

_FIELDS = ("q", "a", "position", "rotation", "fingertip_force")


@dataclass
class Recording:
    """Commands and observations of one grasp: ``n`` commands, ``n + 1`` observations."""

    seed: int = 0
    commands: list[Tensor] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)

    def save(self, path: str | Path) -> Path:
        """Write an HDF5 file: ``commands (n, n_a)`` and one dataset for each sensor [SI]."""
        path = Path(path)
        with require("h5py").File(path, "w") as file:
            file.attrs["format"] = "torch_ekm recording 1"
            file.attrs["seed"] = self.seed
            if self.commands:
                file["commands"] = torch.stack(self.commands).numpy()
            for name in _FIELDS:
                file[name] = torch.stack([getattr(o, name) for o in self.observations]).numpy()
            file["time"] = np.array([o.time for o in self.observations])
            file["status"] = [o.status.value for o in self.observations]
        return path

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Read what :meth:`save` wrote.

        Raises:
            DescriptionError: no such file, not a recording, or a damaged one.
        """
        path = Path(path)
        if not path.is_file():
            raise DescriptionError(path, "no such recording")
        try:
            with require("h5py").File(path, "r") as file:
                if file.attrs.get("format") != "torch_ekm recording 1":
                    raise DescriptionError(path, "this HDF5 file is not a recording of torch_ekm")
                data = {name: torch.from_numpy(file[name][()]) for name in _FIELDS}
                times, status = file["time"][()], [PlantStatus(word.decode()) for word in file["status"][()]]
                commands = list(torch.from_numpy(file["commands"][()])) if "commands" in file else []
                seed = int(file.attrs["seed"])
        except (OSError, KeyError, ValueError) as error:
            if isinstance(error, DescriptionError):
                raise
            raise DescriptionError(path, f"damaged recording: {error}") from None
        observations = [
            Observation(*(data[name][k] for name in _FIELDS), time=float(times[k]), status=status[k])
            for k in range(len(times))
        ]
        return cls(seed, commands, observations)


class RecordingPlant:
    """Passes everything on to a plant and remembers it in ``recording``; implements :class:`Plant`."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.recording = Recording()

    def reset(self, seed: int) -> Observation:
        """Grasp anew, and start a new recording."""
        observation = self.plant.reset(seed)
        self.recording = Recording(seed, [], [observation])
        return observation

    def observe(self) -> Observation:
        """Read the sensors; not recorded."""
        return self.plant.observe()

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Pass the command on."""
        observation = self.plant.command(delta_a)
        self.recording.commands.append(torch.as_tensor(delta_a).detach().cpu().double().clone())
        self.recording.observations.append(observation)
        return observation

    def close(self) -> None:
        """Close the plant; the recording stays."""
        self.plant.close()


class ReplayedPlant:
    """Gives the recorded observations one by one, whatever is commanded; implements :class:`Plant`.

    ``info["recorded_command"]`` says what was commanded then. A driver of a real hand has the same
    five lines: send the increment, wait until it is done, read the sensors.
    """

    def __init__(self, recording: Recording) -> None:
        if not recording.observations:
            raise ParameterError("recording", "empty", "one with at least one observation")
        self.recording = recording
        self._place = 0

    def reset(self, seed: int = 0) -> Observation:
        """Back to the first observation; the seed plays no part."""
        self._place = 0
        return self.observe()

    def observe(self) -> Observation:
        """The observation of this moment."""
        return self.recording.observations[self._place]

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """The next observation.

        Raises:
            ParameterError: the recording ends here.
        """
        if self._place >= len(self.recording.commands):
            raise ParameterError(
                "command", self._place, f"at most {len(self.recording.commands)}: it ends there"
            )
        observation = self.recording.observations[self._place + 1]
        observation.info["recorded_command"] = self.recording.commands[self._place]
        self._place += 1
        return observation

    def close(self) -> None:
        """Nothing to give back."""
