"""Trials as one pandas frame, a row each: what tables and figures are made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..._extras import require
from ..records import Record, TrialRecord
from .statistics import DataFrame

#: What :func:`trial_frame` adds to the figures of a record; NaN where nothing was grasped.
_ADDED = (
    "error_deg", "survivor_error_deg", "survivor_off_deg", "motions",
    "prediction_km", "prediction_ekm", "true_prediction_km", "true_prediction_ekm",
)  # fmt: skip
_COLUMNS = ("job", "grasped", *(field.name for field in dataclasses.fields(TrialRecord)), *_ADDED)


def trial_frame(results: Mapping[str, Iterable[Record]]) -> DataFrame:
    """The trials of all jobs, one row each.

    Columns are the figures of the record and

    ======================  ===============================================================================
    job, grasped            of which job; whether a pinch held the object
    lost, not_reached       as in :class:`~torch_ekm.experiments.records.TrialRecord`
    error_deg               steady-state error: true error at the end; of a lost object the whole angle
    survivor_error_deg      the same, of objects that were not lost
    survivor_off_deg        rotation off the axis at the end, of objects that were not lost
    motions                 their number
    prediction_km, ...      mean over the motions of ``prediction_km_deg``, ...; NaN where there is none
    ======================  ===============================================================================

    Args:
        results: job -> its records.
    """
    rows = [
        {
            "job": job,
            "grasped": record.grasped,
            "reason": record.reason,
            **vars(record),
            **_added(record),
        }
        for job, records in results.items()
        for record in records
    ]
    columns = dict.fromkeys([*_COLUMNS, *(name for row in rows for name in row)])
    return require("pandas").DataFrame(rows, columns=list(columns))


def select(trials: DataFrame, **wanted: Any) -> DataFrame:
    """Trials of grasped objects with these entries."""
    chosen = trials["grasped"].astype(bool)
    for column, value in wanted.items():
        chosen &= trials[column] == value
    return trials[chosen]


def _added(record: Record) -> dict[str, Any]:
    if not isinstance(record, TrialRecord):
        return {"lost": False, "not_reached": False}
    lost, angle = record.lost, abs(record.angle_deg)
    names = [name for name in _ADDED if "prediction" in name]
    made = {name: getattr(record, f"{name}_deg") for name in names}
    return {
        "lost": lost,
        "not_reached": record.not_reached,
        "error_deg": angle if lost else record.true_error_deg,
        "survivor_error_deg": math.nan if lost else record.true_error_deg,
        "survivor_off_deg": math.nan if lost else record.off_rotation_deg,
        "motions": record.steps,
        **{name: float(np.mean(errors)) if errors else math.nan for name, errors in made.items()},
    }
