"""Manipulations with all that was read, estimated, commanded and true, in a log."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...description import load_hand
from ...description.registry import file_digests
from ...exceptions import EKMError, ParameterError
from ...plant import RecordingPlant, TrialLog
from ..config import Setting
from ..runner import Bench


@dataclass(frozen=True)
class RecordConfig:
    """Turns of one object from random grasps.

    Raises:
        UnknownNameError: no such controller; the message lists them.
        ParameterError: no angle, or one that is no rotation.
    """

    setting: Setting = field(default_factory=Setting)
    object: str = "box"
    controller: str = "KM"
    angles_deg: tuple[float, ...] = (10.0, 20.0)

    def __post_init__(self) -> None:
        self.setting.plant_config(self.controller)
        if not self.angles_deg or not all(0 < abs(angle) < 180 for angle in self.angles_deg):
            raise ParameterError("angles_deg", self.angles_deg, "angles between 0 and 180 deg")

    @property
    def configuration(self) -> dict[str, Any]:
        """All that decides the trials, for the log."""
        figures = dataclasses.asdict(self)
        plant = self.setting.plant_config(self.controller)
        parameters = dataclasses.asdict(self.setting.parameters)
        gravity = plant.gravity or load_hand(self.setting.hand).gravity
        files = file_digests(self.setting.hand, [self.object])
        return {
            "hand": self.setting.hand, "gravity": gravity, "parameters": parameters, "files": files, **figures
        }  # fmt: skip


def record(
    config: RecordConfig, seeds: tuple[int, ...], folder: Path, on_trial: Callable[[int], None] | None = None
) -> TrialLog:
    """Turn the object by each angle, for each seed, and log it; what is there already is not run again.

    Trial ``seed * len(angles_deg) + k`` is the turn by angle k. A learner goes on from turn to turn of
    one seed and starts empty with each seed; a seed of which turns are missing is learned again.

    Args:
        on_trial: called with the number of each trial that is there, earlier ones too.

    Raises:
        ParameterError, DescriptionError: ``folder`` has a log of another configuration, or is a file.
        FolderInUseError: another process records there; the message names the process.
        OutputError: the log cannot be written.
    """
    n = len(config.angles_deg)
    with TrialLog(folder, config.configuration) as log:
        for seed in seeds:
            trials = range(seed * n, seed * n + n)
            missing = log.missing(trials)
            bench = None
            if missing:
                bench = Bench(config.setting, config.object, config.controller)
                bench.plant = RecordingPlant(bench.plant)
            for trial, angle in zip(trials, config.angles_deg, strict=True):
                if bench is not None and (trial in missing or bench.learns):
                    _turn(bench, log, seed, trial, angle)
                if on_trial is not None:
                    on_trial(trial)
            if bench is not None:
                bench.close()
    return log


def _turn(bench: Bench, log: TrialLog, seed: int, trial: int, angle: float) -> None:
    assert isinstance(bench.plant, RecordingPlant)
    try:
        outcome = dict(vars(bench.trial(seed, trial, angle)))
    except EKMError as error:  # kept, or the run would stop at this trial each time
        outcome = {"reason": type(error).__name__, "message": str(error)}
    for name in ("seconds", "more"):  # seconds of the wall: equal runs are to give equal logs
        outcome.pop(name, None)
    if trial not in log:
        log.write(trial, bench.plant.trajectory, outcome)
