"""Tables of learning: how well f + g predicts, and from which trial on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .metrics import bootstrap_mean, learning_curve
from .report import Table
from .statistics import Record, bootstrap_ratio, mean_prediction, paired_means, recovery_trials, select
from .tables import percent, text

Array = NDArray[np.float64]


def prediction_table(records: list[Record]) -> Table:
    """One-step prediction error of KM and E-KM on the E-KM's own motions."""
    rows = []
    for item in [*dict.fromkeys(r["object"] for r in records), None]:
        mine = [r for r in select(records, controller="E-KM", kind="turn") if item in (None, r["object"])]
        mine = [r for r in mine if r["prediction_ekm_deg"]]
        if not mine:
            continue
        row = [item or "all"]
        for kind in ("", "true_"):
            ours, theirs = paired_means(
                mine, mine, mean_prediction(kind + "ekm"), mean_prediction(kind + "km")
            )
            ratio = percent(bootstrap_ratio(ours, theirs))
            row += [text(bootstrap_mean(theirs)), text(bootstrap_mean(ours)), ratio]
        rows.append(row)
    header = [
        "object", "KM, measured", "E-KM, measured", "E-KM:KM [%]", "KM, true", "E-KM, true", "E-KM:KM [%]",
    ]  # fmt: skip
    note = (
        "Mean |M_c (ds - prediction)| [deg], the prediction made before the learner trains on the motion. "
        "'Measured' includes the camera's noise, which no model can predict; 'true' does not."
    )
    return Table("prediction", "One-step prediction error", header, rows, note)


def learning_table(
    records: list[Record], events: Sequence[int], trials: int, against_truth: bool = False
) -> Table:
    """How fast the E-KM learns (the paper's Fig. 5b), for each seed and for the mean over seeds.

    Args:
        events: trials (from 1) in which something happened.
        trials: number of trials of a run.
        against_truth: prediction errors free of the camera's noise.
    """
    rows = []
    curves = prediction_curves(records, trials, against_truth)
    for seed, (ekm, km) in curves.items():
        rows.append([str(seed), *_learning_row(ekm, km, events)])
    if len(curves) > 1:
        ekm, km = (np.nanmean([curve[i] for curve in curves.values()], axis=0) for i in (0, 1))
        rows.append(["mean of seeds", *_learning_row(ekm, km, events)])
    header = [
        "seed", "last negative result", "last upper boundary [deg]", "E-KM:KM after 16 trials [%]",
        *(f"recovered after trial {event}" for event in events),
    ]  # fmt: skip
    note = (
        "Per-trial means of the one-step prediction error. Last negative result: last k with p(k) > 0.05 "
        "(the paper: 16; last upper boundary -0.57 deg). Recovered: trials after the event until the "
        "E-KM's error is below half of the KM's; trials with an event are left out of the ratio."
    )
    name, what = ("learning_true", "the truth") if against_truth else ("learning", "measurements")
    return Table(name, f"How fast the E-KM learns: errors against {what}", header, rows, note)


def prediction_curves(
    records: list[Record], trials: int, against_truth: bool = False
) -> dict[int, tuple[Array, Array]]:
    """seed -> per-trial prediction errors of E-KM and KM [deg] ``(trials,)``; NaN where nothing moved."""
    kind = "true_" if against_truth else ""
    curves: dict[int, tuple[Array, Array]] = {}
    for seed in sorted({r["seed"] for r in records}):
        ekm, km = np.full(trials, np.nan), np.full(trials, np.nan)
        for r in select(records, controller="E-KM", seed=seed):
            value = mean_prediction(kind + "ekm")(r), mean_prediction(kind + "km")(r)
            if value[0] is not None and value[1] is not None:
                ekm[r["trial"] - 1], km[r["trial"] - 1] = value
        curves[seed] = ekm, km
    return curves


def _learning_row(ekm: Array, km: Array, events: Sequence[int]) -> list[str]:
    some = np.isfinite(ekm)
    calm = some.copy()
    calm[[event - 1 for event in events]] = False
    late = np.flatnonzero(calm)[np.flatnonzero(calm) >= 16]
    curve = learning_curve(ekm[some], km[some]) if some.sum() > 1 else None
    known = np.nan_to_num(ekm, nan=np.inf)
    # after the last trial there is nothing to see
    back = ["-" if event >= len(km) else recovery_trials(known, km, event) for event in events]
    return [
        "-" if curve is None else str(curve.last_negative),
        "-" if curve is None else f"{curve.last_upper:.2f}",
        f"{100 * ekm[late].mean() / km[late].mean():.0f}" if late.size else "-",
        *("never" if found is None else str(found) for found in back),
    ]
