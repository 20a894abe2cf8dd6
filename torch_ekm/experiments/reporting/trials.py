"""Trials as one pandas frame, a row each: what tables and figures are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..._extras import require
from ..records import TrialRecord
from .statistics import DataFrame

_PREDICTIONS = ("prediction_km", "prediction_ekm", "true_prediction_km", "true_prediction_ekm")


def trial_frame(results: Mapping[str, Iterable[TrialRecord]]) -> DataFrame:
    """The trials of all jobs, one row each.

    Columns are the figures of the record and

    ======================  ===============================================================================
    job, grasped            of which job; whether a pinch held the object
    lost, not_reached       as in :class:`~torch_ekm.experiments.records.TrialRecord`
    error_deg               steady-state error: true error at the end; of a lost object the whole angle
    motions                 their number
    prediction_km, ...      mean over the motions of ``prediction_km_deg``, ...; NaN where there is none
    ======================  ===============================================================================

    Args:
        results: job -> its records.
    """
    rows = [
        {"job": job, **vars(one), **_added(one), **one.more}
        for job, records in results.items()
        for one in records
    ]
    return require("pandas").DataFrame(rows).drop(columns="more")


def select(trials: DataFrame, **wanted: Any) -> DataFrame:
    """Trials of grasped objects with these entries."""
    chosen = trials["grasped"].astype(bool)
    for column, value in wanted.items():
        chosen &= trials[column] == value
    return trials[chosen]


def _added(record: TrialRecord) -> dict[str, Any]:
    made = {name: getattr(record, f"{name}_deg") for name in _PREDICTIONS}
    return {
        "grasped": record.grasped,
        "lost": record.lost,
        "not_reached": record.not_reached,
        "error_deg": abs(record.angle_deg) if record.lost else record.true_error_deg,
        "motions": record.steps if record.grasped else math.nan,
        **{name: float(np.mean(errors)) if errors else math.nan for name, errors in made.items()},
    }
