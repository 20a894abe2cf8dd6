"""Made-up records of turns."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pandas

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
