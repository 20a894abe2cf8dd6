"""What was aimed at, what was measured, and by how much it is missed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..protocols.object_memory import judge_assignment
from .learning_tables import prediction_curves
from .metrics import learning_curve
from .report import Table
from .statistics import (
    Record,
    Value,
    bootstrap_ratio,
    compare,
    paired_means,
    recovery_trials,
    select,
    settle_steps,
    steady_state_error,
    unit_means,
)

Row = list[str]


def targets_table(rows: list[Row]) -> Table:
    """Rows of :func:`goal` as a table."""
    note = "Targets were set before the figures were known."
    return Table("targets", "Targets", ["target", "aim", "measured", "met"], rows, note)


def goal(what: str, aim: float, measured: float, unit: str = "", least: bool = False) -> Row:
    """One row: met, or by how much not.

    Args:
        least: the aim is a lower bound; else an upper one.
    """
    met = measured >= aim if least else measured <= aim
    sign = "at least" if least else "at most"
    miss = "yes" if met else f"no, by {abs(measured - aim):.3g}{unit}"
    return [what, f"{sign} {aim:g}{unit}", f"{measured:.3g}{unit}", miss]


def generalize_targets(records: list[Record], limit: int) -> list[Row]:
    """Of the generalisation experiment."""

    def pair(ours: str, theirs: str, value: Value, item: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        mine = [r for r in records if item in (None, r["object"])]
        return paired_means(
            select(mine, controller=ours, kind="turn"), select(mine, controller=theirs, kind="turn"), value
        )

    rows = []
    for item in dict.fromkeys(r["object"] for r in records):
        ours, theirs = pair("E-KM", "KM", steady_state_error, item)
        if len(ours):
            ratio = bootstrap_ratio(ours, theirs)
            rows.append(goal(f"steady-state error E-KM : KM, {item}", 25, 100 * ratio.mean, " %"))
    tests = compare(*pair("E-KM", "KM", steady_state_error))
    if tests is not None:
        p = tests.welch_p
        rows.append(["Welch p over all objects", "below 1e-06", f"{p:.1g}", "yes" if p < 1e-6 else "no"])

    def share(what: str, aim: float, value: Value) -> None:
        for name in ("E-KM", "E-KM+I"):
            ours, theirs = pair(name, "KM+I", value)
            if len(ours) and theirs.mean() > 0:
                ratio = 100 * bootstrap_ratio(ours, theirs).mean
                rows.append(goal(f"{what} {name} : KM+I", aim, ratio, " %"))

    share("steady-state error", 100, steady_state_error)
    share("motions to settle", 60, lambda r: settle_steps(r, limit=limit))
    share("error of the first motion", 50, lambda r: r["first_step_deg"])
    lost = {
        name: 100 * float(np.mean([r["lost"] for r in turns]))
        for name in ("E-KM", "KM+I")
        if (turns := select(records, controller=name, kind="turn"))
    }
    if len(lost) == 2:
        rows.append(goal("objects lost, E-KM minus KM+I", 0, lost["E-KM"] - lost["KM+I"], " %"))
        rows.append(goal("objects lost, E-KM", 5, lost["E-KM"], " %"))
    km = unit_means(select(records, controller="KM", kind="turn"), steady_state_error)
    if km:
        mean = float(np.mean(list(km.values())))
        inside = 1 <= mean <= 3
        rows.append(
            ["steady-state error of the KM", "1 to 3 deg", f"{mean:.2f} deg", "yes" if inside else "no"]
        )
    return rows


def online_targets(records: list[Record], events: Sequence[int], trials: int) -> list[Row]:
    """Of the online experiment: each figure is the mean over seeds."""
    negatives, late, back = [], [], []
    for ekm, km in prediction_curves(records, trials).values():
        some = np.isfinite(ekm)
        if some.sum() > 1:
            negatives.append(learning_curve(ekm[some], km[some]).last_negative)
        calm = some.copy()
        calm[[event - 1 for event in events]] = False
        calm[:16] = False
        if calm.any():
            late.append(100 * ekm[calm].mean() / km[calm].mean())
        for event in events:
            if event < trials:
                found = recovery_trials(np.nan_to_num(ekm, nan=np.inf), km, event)
                back.append(found is not None and found <= 3)
    rows = []
    if negatives:
        rows.append(goal("last index of negative result, mean of seeds", 10, float(np.mean(negatives))))
        rows.append(goal("the same, worst seed", 10, float(np.max(negatives))))
    if late:
        rows.append(goal("prediction error E-KM : KM after 16 trials", 35, float(np.mean(late)), " %"))
    true = [
        100 * np.nanmean(ekm[16:]) / np.nanmean(km[16:])
        for ekm, km in prediction_curves(records, trials, against_truth=True).values()
        if trials > 16
    ]
    if true:
        rows.append(goal("the same against the plant's truth", 35, float(np.mean(true)), " %"))
    if back:
        share = 100 * float(np.mean(back))
        rows.append(goal("events after which half is reached within 3 trials", 100, share, " %", least=True))
    return rows


def adapt_targets(sessions: list[list[Record]]) -> list[Row]:
    """Of the object memory."""
    judged = [judge_assignment(records) for records in sessions]
    total = sum(assignment.judged for assignment in judged)
    rows = []
    if total:
        right = 100 * sum(assignment.right for assignment in judged) / total
        rows.append(goal("turns that went to the right model", 90, right, " %", least=True))
    rows.append(goal("models, most in one sequence", 8, max(assignment.n_models for assignment in judged)))
    errors = {
        name: np.mean([e for records in sessions for r in records for e in r["memory_errors_deg"][name]])
        for name in ("bank", "labelled", "one model", "fresh")
    }
    for other, aim in (("labelled", 105), ("one model", 100), ("fresh", 100)):
        share = 100 * float(errors["bank"] / errors[other])
        rows.append(goal(f"prediction error, bank : {other}", aim, share, " %"))
    return rows
