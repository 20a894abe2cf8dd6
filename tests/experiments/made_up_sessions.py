"""Made-up records of turns, and sessions of them: reports are tested with them, not the hand."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas

from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.online import Online
from torch_ekm.experiments.records import NOT_GRASPED, TrialRecord
from torch_ekm.experiments.reporting.statistics import trial_frame

FIGURES: dict[str, Any] = {
    "object": "box", "kind": "turn", "controller": "KM", "seed": 0, "trial": 1, "angle_deg": 20.0,
    "reason": "reached", "message": "", "true_error_deg": 1.0, "errors_deg": (20.0, 8.0, 0.4, 0.3),
    "first_step_deg": 0.5, "prediction_km_deg": (0.6, 0.4),
    "prediction_ekm_deg": (0.3, 0.1), "true_prediction_km_deg": (0.5, 0.5),
    "true_prediction_ekm_deg": (0.1, 0.1), "off_rotation_deg": 1.0, "seconds": (0.01,) * 3,
}  # fmt: skip


def turn(controller: str = "KM", seed: int = 0, error: float = 1.0, **changes: Any) -> TrialRecord:
    """A turn of 20 deg in three motions."""
    return TrialRecord(
        **{**FIGURES, "controller": controller, "seed": seed, "true_error_deg": error, **changes}
    )


def not_grasped(controller: str = "KM", seed: int = 0, **changes: Any) -> TrialRecord:
    """The same without a grasp."""
    about = {key: FIGURES[key] for key in ("object", "kind", "trial", "angle_deg")}
    about |= {"controller": controller, "seed": seed, "reason": NOT_GRASPED, "message": "too wide"}
    return TrialRecord(**{**about, **changes})


def frame(records: Iterable[TrialRecord]) -> pandas.DataFrame:
    """These trials, of one job."""
    return trial_frame({"job": records})


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
