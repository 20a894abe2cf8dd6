"""Made-up sessions: reports are tested with them, not the hand."""

from __future__ import annotations

import numpy as np
from experiments_records import turn

from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.online import Online
from torch_ekm.experiments.records import TrialRecord


def made_up_turn(controller: str, seed: int, trial: int, angle: float, item: str) -> TrialRecord:
    """A made-up turn, decided by its arguments: reports are tested here, not the hand."""
    draw = np.random.default_rng([seed, trial, len(controller), len(item)])
    n = int(draw.integers(3, 9))
    km = tuple(draw.uniform(0.3, 0.7, n).tolist())
    ekm = tuple(draw.uniform(0.1, 0.3, n).tolist()) if controller.startswith("E-KM") else ()
    return turn(
        controller, seed, float(draw.uniform(0, 0.3)), trial=trial, angle_deg=angle, object=item,
        errors_deg=tuple(np.linspace(angle, 0.1, n + 1).tolist()),
        first_step_deg=float(draw.uniform(0.1, 1)), prediction_km_deg=km, prediction_ekm_deg=ekm,
        true_prediction_km_deg=km, true_prediction_ekm_deg=ekm,
        off_rotation_deg=float(draw.uniform(0, 2)), seconds=(0.01,) * n,
    )  # fmt: skip


def made_up_online(protocol: Online, controller: str, seed: int) -> list[TrialRecord]:
    trials = range(1, protocol.trials + 1)
    return [made_up_turn(controller, seed, trial, 8.0, "toothpaste") for trial in trials]


def made_up_generalize(protocol: Generalize, item: str, controller: str, seed: int) -> list[TrialRecord]:
    return [
        made_up_turn(controller, seed, k, angle, item) for k, angle in enumerate(protocol.angles_of(item))
    ]
